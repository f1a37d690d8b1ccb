"""Frames from 360° videos: sharp, an even baseline apart; none while standing; nothing hostile gets through."""

import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.scene.errors import InputError
from panolog.scene.files import SUFFIX
from panolog.scene.sfm import frames as module
from panolog.scene.sfm import video as video_module
from panolog.scene.sfm.frames import extract_frames
from panolog.scene.sfm.motion import Motion, Piece, sharpness
from panolog.scene.sfm.selection import choose
from tests.scene.sfm.videos import HEIGHT, WIDTH, Image, Shot, render, turn, walk, write_video

PARALLAX = 5.0


def numbers(files: list[Path]) -> list[int]:
    return [int(file.stem.rpartition("_")[2]) for file in files]


def motion(shots: list[Shot]) -> list[Piece]:
    """What is found in rendered shots, without a codec in between."""
    found = Motion(WIDTH)
    for number, shot in enumerate(shots):
        found.add(number, render(shot))
    return found.finish()


@pytest.fixture(scope="module")
def tour() -> list[Shot]:
    """Slowly, fast, standing, turning on the spot, on again; every third frame of a walk is blurred."""
    slow, fast = walk([0.06] * 30), walk([0.2] * 15, start=1.8)
    standing = [replace(fast[-1], turn=(it % 3 * 0.2, 0.0, 0.0)) for it in range(15)]
    turning = turn(fast[-1], np.arange(0.0, 200.0, 8.0))
    last = walk([0.12] * 25, start=4.8)
    end = turning[-1].turn[0]
    last = [replace(it, turn=(it.turn[0] + end, *it.turn[1:])) for it in last]
    shots = [*slow, *fast, *standing, *turning, *last]
    moving = {*range(45), *range(85, 110)}
    return [replace(it, blur=2.5) if n % 3 == 1 and n in moving else it for n, it in enumerate(shots)]


@pytest.fixture(scope="module")
def images(tour: list[Shot]) -> list[Image]:
    return [render(shot) for shot in tour]


@pytest.fixture
def tour_video(images: list[Image], tmp_path: Path) -> Path:
    return write_video(tmp_path / "tour.mp4", images, fourcc="mp4v")


@pytest.fixture
def short(images: list[Image], tmp_path: Path) -> Path:
    """Eight frames that move."""
    return write_video(tmp_path / "short.avi", images[30:45:2])


def test_even_baseline_sharp_frames_and_none_at_rest(
    tour: list[Shot], tour_video: Path, tmp_path: Path
) -> None:
    files = extract_frames(tour_video, tmp_path / "out", parallax=PARALLAX)
    chosen = numbers(files)
    steps = np.diff([tour[number].along for number in chosen])
    # Blurred or not, there is a frame every 0.2 m of the fast part: half of that either side is in its nature.
    assert steps.max() / steps.min() < 1.9, steps
    assert 0.25 < steps.mean() < 0.6
    assert sum(45 <= number < 85 for number in chosen) <= 1
    assert not [number for number in chosen if tour[number].blur]
    assert chosen[0] <= 3 and tour[chosen[-1]].along > tour[-1].along - 0.15
    assert [file.name for file in files] == sorted(file.name for file in files)
    assert files[0].name == f"tour_{chosen[0]:06d}.jpg"
    picture = cv2.imread(str(files[3]))
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(picture.astype(int) - render(tour[chosen[3]])).mean() < 10


def test_equal_steps_are_equal_parallax_and_turns_are_none() -> None:
    moving = walk([0.1] * 12)
    (piece,) = motion([*moving, *turn(moving[-1], np.arange(0.0, 360.0, 30.0))])
    assert len(piece.frames) == 24
    steps = np.diff(piece.positions)
    assert steps[:11].std() < 0.2 * steps[:11].mean()
    assert np.abs(steps[11:]).max() < 0.3


def test_a_whip_turn_too_blurred_to_follow_is_no_motion() -> None:
    start = Shot(0.0)
    smeared = [replace(it, blur=40.0) for it in turn(start, np.arange(25.0, 150.0, 25.0))]
    pieces = motion([start] * 3 + smeared + [replace(start, turn=(150.0, 0.0, 0.0))] * 3)
    assert len(pieces) == 1
    assert max(pieces[0].positions) < 0.5


def test_what_moves_by_itself_is_no_motion() -> None:
    (piece,) = motion([Shot(0.0, mover=float(it * 6)) for it in range(25)])
    assert len(piece.frames) == 25
    assert max(piece.positions) < 0.5


def test_a_cut_begins_anew_and_both_ends_of_it_are_there() -> None:
    first, second = walk([0.15] * 10), walk([0.15] * 10, start=400.0)
    pieces = motion([*first, *second])
    assert [len(piece.frames) for piece in pieces] == [10, 10]
    chosen = choose(pieces, PARALLAX, None)
    assert {0, 10} <= {number // 2 * 2 for number in chosen}
    assert any(number in (8, 9) for number in chosen) and any(number in (18, 19) for number in chosen)


def test_of_a_time_lapse_every_frame_is_there() -> None:
    pieces = motion([Shot(along) for along in np.arange(6) * 37.0])
    assert choose(pieces, PARALLAX, None) == list(range(6))


def test_flashes_and_black_frames_are_left_out() -> None:
    found = Motion(WIDTH)
    for number, shot in enumerate(walk([0.1] * 16)):
        white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        found.add(number, {0: 0 * white, 5: white, 9: 0 * white, 10: 0 * white}.get(number, render(shot)))
    (piece,) = found.finish()
    assert set(range(16)).difference(piece.frames) == {0, 5, 9, 10}


def test_sharpness_is_that_of_the_picture_not_of_its_exposure_or_orientation() -> None:
    grey = [
        cv2.cvtColor(render(shot, bearer=False), cv2.COLOR_BGR2GRAY)
        for shot in (Shot(0.0), Shot(0.0, (70.0, 0.0, 0.0)), Shot(0.0, blur=1.5))
    ]
    here, turned, blurred = map(sharpness, grey)
    assert turned == pytest.approx(here, rel=0.1)
    assert blurred < 0.5 * here
    assert sharpness(np.asarray(grey[0] // 2, np.uint8)) == pytest.approx(here, rel=0.1)
    assert sharpness(np.zeros((HEIGHT, WIDTH), np.uint8)) == 0


@pytest.mark.parametrize("most", [2, 3, 7, 20, 40])
def test_fewer_frames_are_as_even(most: int) -> None:
    piece = Piece(list(range(1000)), list(np.linspace(0, 200, 1000)), [1.0] * 1000)
    chosen = choose([piece], PARALLAX, most)
    assert most * 0.9 - 1 <= len(chosen) <= most
    assert (chosen[0], chosen[-1]) == (0, 999)
    assert max(np.diff(chosen)) <= 1.05 * min(np.diff(chosen))


def test_more_pieces_than_frames_wanted() -> None:
    pieces = [Piece([number], [0.0], [1.0]) for number in range(50)]
    assert choose(pieces, PARALLAX, 5) == [0, 12, 24, 37, 49]


def test_a_blurred_stretch_is_stepped_over() -> None:
    positions = np.arange(0, 20.5, 0.25)
    blurred = (positions > 8.9) & (positions < 11.1)  # around the third place, 10 degrees
    piece = Piece(list(range(len(positions))), positions.tolist(), np.where(blurred, 0.1, 1.0).tolist())
    chosen = choose([piece], PARALLAX, None)
    assert len(chosen) == 5 and not blurred[chosen].any()


def test_a_standing_camera_gives_no_scene(tmp_path: Path) -> None:
    shots = [Shot(0.01 * np.sin(it), (0.3 * it, 0.0, 0.0)) for it in range(12)]
    video = write_video(tmp_path / "still.avi", [render(shot) for shot in shots])
    with pytest.raises(InputError, match="still.avi: the camera moves by less than 4 degrees"):
        extract_frames(video, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_goes_on_where_it_was_stopped(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = extract_frames(short, tmp_path / "whole", parallax=PARALLAX)
    assert len(whole) >= 3
    told: list[tuple[int, int]] = []

    def stop(done: int, total: int) -> None:
        told.append((done, total))
        if done == 8 + numbers(whole)[1] + 1:  # the second frame has just been written
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        extract_frames(short, out, parallax=PARALLAX, progress=stop)
    assert told == [(n, 16) for n in range(1, 9)] + [
        (9 + n, 9 + numbers(whole)[-1]) for n in range(len(told) - 8)
    ]
    kept = {path: path.stat().st_mtime_ns for path in sorted(out.glob("*.jpg"))}
    assert [path.name for path in kept] == [path.name for path in whole[:2]]
    assert not list(out.glob(f".*{SUFFIX}"))
    monkeypatch.setattr(module, "_search", None)  # the motion is known
    (out / f".short_000001.jpg.1234{SUFFIX}").write_bytes(b"of a killed writer")
    again = extract_frames(short, out, parallax=PARALLAX)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in whole]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        path.name for path in (tmp_path / "whole").iterdir()
    )
    monkeypatch.setattr(module, "open_video", None)  # all is there
    assert extract_frames(short, out, parallax=PARALLAX) == again


def test_another_choice_replaces_the_first(short: Path, tmp_path: Path) -> None:
    extract_frames(short, tmp_path / "out", parallax=2.0)
    (tmp_path / "out" / "short_999999.jpg").write_bytes(b"of the user")
    files = extract_frames(short, tmp_path / "out", parallax=2.0, most=2)
    assert len(files) == 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *(file.name for file in files),
        "short.motion.json",
        "short_999999.jpg",
    }


def test_another_video_of_the_same_name_is_refused(short: Path, images: list[Image], tmp_path: Path) -> None:
    out = tmp_path / "out"
    before = [path.read_bytes() for path in extract_frames(short, out)]
    write_video(short, images[32:45:2])
    with pytest.raises(InputError, match="another video of the name short"):
        extract_frames(short, out)
    assert [path.read_bytes() for path in sorted(out.glob("*.jpg"))] == before


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: b"\xff\xfe",
        lambda text: b"[" * 100_000,
        lambda text: text.replace(b'"version": 1', b'"version": 0'),
        lambda text: text.replace(b'"positions": [0.0', b'"positions": [NaN'),
        lambda text: text.replace(b'"frames": [0', b'"frames": [-1'),
        lambda text: text.replace(b'"decoded": 8', b'"decoded": 1e999'),
        lambda text: text.replace(b'"pieces": [', b'"pieces": [7, '),
    ],
)
def test_a_damaged_file_of_motion_is_made_anew(
    damage: Callable[[bytes], bytes], short: Path, tmp_path: Path
) -> None:
    files = extract_frames(short, tmp_path / "out")
    file = tmp_path / "out" / "short.motion.json"
    good = file.read_bytes()
    file.write_bytes(damage(good))
    assert file.read_bytes() != good
    assert extract_frames(short, tmp_path / "out") == files
    assert file.read_bytes() == good


def test_what_is_there_of_a_truncated_video_is_used(
    tour_video: Path, images: list[Image], tmp_path: Path
) -> None:
    whole = write_video(tmp_path / "cut.avi", images[20:45])
    whole.write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    notes: list[str] = []
    files = extract_frames(whole, tmp_path / "out", parallax=PARALLAX, note=notes.append)
    assert len(files) >= 3
    assert max(numbers(files)) < 16
    (line,) = notes
    assert re.search(r"cut.avi: ends after 1\d of the 25 frames", line)
    tour_video.write_bytes(tour_video.read_bytes()[:-20_000])  # the index of an mp4 is at its end
    with pytest.raises(InputError, match="tour.mp4: cannot be opened"):
        extract_frames(tour_video, tmp_path / "out2")
    assert not (tmp_path / "out2").exists()


@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"no video\n" * 500, bytes(range(256)) * 64])
def test_garbage(content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be opened")):
        extract_frames(path, tmp_path / "out")
    with pytest.raises(InputError, match="cannot be read"):
        extract_frames(tmp_path / "missing.mp4", tmp_path / "out")
    with pytest.raises(InputError, match="cannot be read"):
        extract_frames(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("size", "said"), [((512, 512), "2:1"), ((640, 360), "2:1"), ((256, 512), "2:1"), ((64, 32), "too few")]
)
def test_frames_that_are_no_panoramas(size: tuple[int, int], said: str, tmp_path: Path) -> None:
    video = write_video(tmp_path / "flat.avi", [np.zeros((size[1], size[0], 3), np.uint8)] * 3)
    with pytest.raises(InputError, match=f"flat.avi: its frames .*{said}"):
        extract_frames(video, tmp_path / "out")


def test_fisheyes_side_by_side(images: list[Image], tmp_path: Path) -> None:
    mask = np.zeros((HEIGHT, WIDTH, 1), np.uint8)
    for u in (WIDTH // 4, 3 * WIDTH // 4):
        cv2.circle(mask, (u, HEIGHT // 2), HEIGHT // 2, 1, -1)
    video = write_video(tmp_path / "raw.avi", [image * mask for image in images[:3]])
    with pytest.raises(InputError, match="raw.avi: its frames are two fisheye circles; stitch it"):
        extract_frames(video, tmp_path / "out")


@pytest.mark.parametrize("bad", [0.0, -1.0, 46.0, float("nan")])
def test_options_out_of_bounds(bad: float, short: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give an angle above 0"):
        extract_frames(short, tmp_path, parallax=bad)
    with pytest.raises(InputError, match="give at least 2"):
        extract_frames(short, tmp_path, most=1)


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
    assert max(totals) <= 2 * min(len(data), video_module.MAX_FRAMES)
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


@pytest.mark.parametrize("seed", range(12))
def test_mutated_bytes_crash_nothing(seed: int, short: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    data = bytearray(short.read_bytes())
    reach = 6000 if seed % 2 else len(data)  # the headers, or all of it
    for at in random.integers(0, reach, 12):
        data[at] = random.integers(256)
    short.write_bytes(data)
    try:
        files = extract_frames(short, tmp_path / "out", most=4)
    except InputError as error:
        assert str(short) in str(error) and "\n" not in str(error)
    else:
        assert all(cv2.imread(str(file)).shape[1] % 2 == 0 for file in files)


def test_a_frame_of_another_size_is_left_out(short: Path, images: list[Image], tmp_path: Path) -> None:
    data = short.read_bytes()
    small = cv2.imencode(".jpg", cv2.resize(images[0], (256, 128)))[1].tobytes()
    at = data.index(b"00dc", data.index(b"00dc") + 4) + 4  # the second frame
    length = struct.unpack("<I", data[at : at + 4])[0]
    assert len(small) < length
    short.write_bytes(data[: at + 4] + small + bytes(length - len(small)) + data[at + 4 + length :])
    notes: list[str] = []
    files = extract_frames(short, tmp_path / "out", parallax=2.0, note=notes.append)
    assert 1 not in numbers(files) and len(files) >= 3
    assert "1 damaged frames, or of another size" in notes[0]


@pytest.mark.parametrize("quarters", [1, 2])
def test_only_a_half_turn_of_the_picture_is_undone(
    quarters: int, images: list[Image], tmp_path: Path
) -> None:
    video = write_video(tmp_path / "turned.mp4", images[30:45:2], fourcc="mp4v")
    data = bytearray(video.read_bytes())
    matrix = {1: (0, 0x10000, 0, -0x10000, 0, 0), 2: (-0x10000, 0, 0, 0, -0x10000, 0)}[quarters]
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 24] = struct.pack(">6i", *matrix)
    video.write_bytes(data)
    first = cv2.imread(str(extract_frames(video, tmp_path / "out", parallax=2.0)[0])).astype(int)
    number = numbers(sorted((tmp_path / "out").glob("*.jpg")))[0]
    expected = images[30 + 2 * number]
    if quarters == 2:
        expected = np.asarray(expected[::-1, ::-1], np.uint8)
    assert np.abs(first - expected).mean() < 12


def test_names_are_safe_and_the_file_is_small(images: list[Image], tmp_path: Path) -> None:
    video = write_video(tmp_path / "my walk (1).v2.avi", images[30:45:2])
    files = extract_frames(video, tmp_path / "deep" / "out")
    assert files[0].name.startswith("my_walk__1__v2_0000")
    described = json.loads((tmp_path / "deep" / "out" / "my_walk__1__v2.motion.json").read_text())
    assert described["chosen"] == numbers(files)
