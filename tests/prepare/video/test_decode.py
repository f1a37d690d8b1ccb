"""Videos that are truncated, damaged, hostile or no panoramas."""

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.video.decode import MAX_FRAMES
from panolog.prepare.video.frames import extract_frames
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode
from tests.prepare.video.videos import HEIGHT, WIDTH, numbers, short_video, tour_images, write_video

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def short_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A video of eight frames that move."""
    return short_video(tmp_path_factory.mktemp("video") / "short.avi").read_bytes()


@pytest.fixture
def short(short_bytes: bytes, tmp_path: Path) -> Path:
    """The same as a file that the test may damage."""
    (tmp_path / "short.avi").write_bytes(short_bytes)
    return tmp_path / "short.avi"


def test_what_is_there_of_a_truncated_video_is_used(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "cut.avi", tour_images(20, 45))
    whole.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    notes: list[str] = []
    files = extract_frames(whole, tmp_path / "out", note=notes.append)
    assert len(files) >= 3
    assert max(numbers(files)) < 16
    ends, damaged = notes
    assert re.search(r"cut.avi: ends after 1\d of the 25 frames", ends)
    assert "1 damaged frames" in damaged  # the one that is cut off
    video = write_video(tmp_path / "tour.mp4", tour_images(20), fourcc="mp4v")
    video.write_bytes(video.read_bytes()[:-2000])  # the index of an mp4 is at its end
    with pytest.raises(InputError, match=r"tour\.mp4: cannot be opened"):
        extract_frames(video, tmp_path / "out2")
    assert not (tmp_path / "out2").exists()


@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"no video\n" * 500, bytes(range(256)) * 64])
def test_garbage_is_one_line_and_nothing_is_printed(
    content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be opened as a video; it is damaged")):
        extract_frames(path, tmp_path / "out")
    with pytest.raises(InputError, match="cannot be read"):
        extract_frames(tmp_path / "missing.mp4", tmp_path / "out")
    with pytest.raises(InputError, match="cannot be read"):
        extract_frames(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert capfd.readouterr() == ("", "")  # also by FFmpeg


def test_frames_that_are_too_small(tmp_path: Path) -> None:
    video = write_video(tmp_path / "flat.avi", [np.zeros((32, 64, 3), np.uint8)] * 3)
    with pytest.raises(InputError, match=r"flat\.avi: its .*256 to 12288"):
        extract_frames(video, tmp_path / "out")


def test_fisheyes_side_by_side(tmp_path: Path) -> None:
    mask = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    for u in (WIDTH // 4, 3 * WIDTH // 4):
        cv2.circle(mask, (u, HEIGHT // 2), HEIGHT // 2, 1, -1)
    video = write_video(tmp_path / "raw.avi", [image * mask for image in tour_images(3)])
    with pytest.raises(InputError, match=r"raw\.avi: its two fisheye circles cannot be stitched: "):
        extract_frames(video, tmp_path / "out")


def test_a_header_that_promises_the_world(short: Path, tmp_path: Path) -> None:
    data = bytearray(short.read_bytes())
    for at in (data.index(b"avih") + 8 + 16, data.index(b"strh") + 8 + 32):  # frames in all, of the stream
        data[at : at + 4] = struct.pack("<I", 0x7FFFFFFF)
    short.write_bytes(data)
    notes: list[str] = []
    totals = set[int]()
    files = extract_frames(
        short, tmp_path / "out", note=notes.append, progress=lambda done, total: totals.add(total)
    )
    assert len(files) >= 3
    assert max(totals) <= 2 * min(len(data), MAX_FRAMES)
    assert "ends after 8 of the" in notes[0]


@pytest.mark.parametrize("size", [(60_000, 30_000), (0x7FFFFFFE, 0x3FFFFFFF), (0, 0), (22_000, 11_000)])
def test_a_header_of_absurd_frames(size: tuple[int, int], short: Path, tmp_path: Path) -> None:
    data = bytearray(short.read_bytes())
    at = data.index(b"strf") + 8 + 4
    data[at : at + 8] = struct.pack("<II", *size)
    for frame in [found.start() for found in re.finditer(b"\xff\xc0\x00\x11\x08", bytes(data))]:
        data[frame + 5 : frame + 9] = struct.pack(">HH", size[1] & 0xFFFF, size[0] & 0xFFFF)
    short.write_bytes(data)
    with pytest.raises(InputError, match=re.escape(str(short))):
        extract_frames(short, tmp_path / "out")


def test_a_frame_of_another_size_spoils_no_other(short: Path, tmp_path: Path) -> None:
    data = short.read_bytes()
    frame = [found.start() for found in re.finditer(b"00dc", data)][2] + 4  # of a header, the first, this one
    resized = cv2.resize(tour_images(1)[0], (400, 200))
    small = cv2.imencode(".jpg", resized, [cv2.IMWRITE_JPEG_QUALITY, 20])[1].tobytes()
    (length,) = struct.unpack("<I", data[frame : frame + 4])
    assert len(small) < length
    rest = data[frame + 4 + length :]
    short.write_bytes(data[: frame + 4] + small + bytes(length - len(small)) + rest)
    files = extract_frames(short, tmp_path / "out", parallax=2.0)
    assert len(files) >= 3
    assert all(decode(file, cv2.IMREAD_COLOR).shape == (HEIGHT, WIDTH, 3) for file in files)
