"""MP4 files that are truncated, damaged or hostile: one clear line, or the frames that are there."""

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.video.boxes import Box, BoxReader
from panolog.prepare.video.decode import open_video
from panolog.prepare.video.frames import extract_frames
from panolog.prepare.video.spherical import read_spherical
from panolog.prepare.video.telemetry import read_telemetry
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode
from tests.prepare.video.containers import (
    H264,
    H265,
    Encoding,
    add_spherical,
    add_spherical_xml,
    add_track,
    box,
    full,
    insert,
    known_frames,
    write_clip,
)
from tests.prepare.video.sensors import camm, gps5, payload
from tests.prepare.video.videos import tour_images, write_video

pytestmark = pytest.mark.system


def clip(folder: Path) -> Path:
    """A clip with all boxes that are read."""
    path = write_clip(folder / "clip.mp4", known_frames(12), H264)
    return add_spherical_xml(add_spherical(path, stereo=0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A clip with a track of GPMF."""
    places = payload(gps5(np.array([[47.0, 8.0, 400.0]])))
    return add_track(clip(tmp_path_factory.mktemp("clip")), b"gpmd", [(0, places)], 400).read_bytes()


@pytest.fixture(scope="module")
def felt(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A clip with a track of CAMM."""
    packets = [(50 * n, camm(3, 0.0, 9.81, 0.0)) for n in range(8)]
    return add_track(clip(tmp_path_factory.mktemp("felt")), b"camm", packets, 400).read_bytes()


def use(path: Path) -> int:
    """Decodes a video as far as it goes; the number of frames, 0 if it is refused in one line."""
    try:
        with open_video(path) as video:
            for _ in video.frames():
                video.grey(), video.picture()
            assert all(str(path) in note and "\n" not in note for note in video.notes())
            return video.decoded
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return 0


def sense(path: Path) -> None:
    """Reads a video's telemetry, which is finite or refused in one line."""
    try:
        found, notes = read_telemetry(path)
    except InputError as error:
        found, notes = None, [str(error)]
    assert all(str(path) in note and "\n" not in note for note in notes)
    if found is not None:
        assert np.isfinite(found.ups.values).all() and np.isfinite(found.places.values[:, :2]).all()


@pytest.mark.parametrize("seed", range(8))
def test_mutated_headers(seed: int, whole: bytes, felt: bytes, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    path, clean = tmp_path / "clip.mp4", felt if seed % 2 else whole
    start = clean.index(b"moov")
    for _ in range(12):
        data = bytearray(clean)
        for at in random.integers(start, len(data), 6):
            data[at] = random.integers(256)
        path.write_bytes(data)
        assert use(path) <= 12
        read_spherical(path)
        sense(path)


@pytest.mark.parametrize("encoding", [H264, H265], ids=lambda it: it.codec)
def test_mutated_frames_are_the_same_each_time(encoding: Encoding, tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.mp4", known_frames(12), encoding)
    clean = path.read_bytes()
    for seed in range(6):
        random = np.random.default_rng(seed)
        data = bytearray(clean)
        for at in random.integers(48, clean.index(b"moov"), 5):
            data[at : at + 8] = random.bytes(8)
        path.write_bytes(data)
        first, second = (_pixels(path) for _ in range(2))
        assert first == second


def _pixels(path: Path) -> list[bytes | None]:
    try:
        with open_video(path) as video:
            pictures = [(video.time, video.picture()) for _ in video.frames()]
    except InputError:
        return []
    return [None if it is None else struct.pack("d", time) + it.tobytes() for time, it in pictures]


def test_boxes_end_where_the_one_around_them_does() -> None:
    sizes = (0, 1, 7, 8, 9, 2**31, 2**32 - 1)
    contents = [struct.pack(">I4s", size, b"free") + bytes(4) for size in sizes]
    contents += [struct.pack(">I4sQ", 1, b"free", size) for size in (0, 8, 16, 17, 2**63, 2**64 - 1)]
    for inner in contents:
        data = box(b"moov", inner, inner) + box(b"mdat", bytes(50))
        reader = BoxReader(io.BytesIO(data), len(data))
        outer, *_ = reader.find(reader.file, "moov")
        found = list(reader.children(outer))
        assert all(outer.start <= it.start and it.end <= outer.end for it in found if it.start <= it.end)
        assert len(found) <= 4
        assert all(len(reader.read(it)) <= len(inner) * 2 for it in found)


def test_few_boxes_are_looked_at() -> None:
    tiny = box(b"trak") * 300_000
    data = box(b"moov", box(b"trak", tiny), tiny)
    reader = BoxReader(io.BytesIO(data), len(data))
    assert len(reader.find(reader.file, "moov/trak/trak")) < 70_000
    assert list(reader.children(Box(b"moov", 0, len(data)))) == []  # that was all


def test_nested_boxes_and_elements(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    deep = b""
    for _ in range(2_000):
        deep = box(b"moov", deep)
    path.write_bytes(whole + deep)
    assert use(path) in (0, 12)
    path.write_bytes(whole)
    insert(path, "moov/trak/mdia/minf/stbl/stsd/*", box(b"sv3d", *[full(b"proj")] * 500))
    assert use(path) in (0, 12)


def test_the_frames_of_a_damaged_video_are_the_same_after_an_interruption(tmp_path: Path) -> None:
    clean = write_video(tmp_path / "short.mp4", tour_images(30, 45, 2), fourcc="mp4v").read_bytes()
    data = bytearray(clean)
    middle = (48 + clean.index(b"moov")) // 2
    data[middle : middle + 200] = bytes(200)
    path = tmp_path / "short.mp4"
    path.write_bytes(data)
    files = extract_frames(path, tmp_path / "out", parallax=2.0)
    contents = {file.name: file.read_bytes() for file in files}
    for file in files[1::2]:
        file.unlink()
    again = extract_frames(path, tmp_path / "out", parallax=2.0)
    assert {file.name: file.read_bytes() for file in again} == contents
    assert all(decode(file, cv2.IMREAD_COLOR).shape == (256, 512, 3) for file in files)
