"""Frames from 360° videos: sharp, an even baseline apart, none at rest; interrupted and resumed."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.video import frames as module
from panolog.prepare.video import streams
from panolog.prepare.video.decode import Video
from panolog.prepare.video.frames import extract_frames
from panolog.prepare.video.motion import load_motion
from panolog.prepare.video.selection import search
from panolog.scene.errors import InputError
from panolog.scene.files import SUFFIX
from panolog.scene.image_files import decode
from panolog.scene.write import no_progress
from tests.prepare.video.videos import (
    HEIGHT,
    WIDTH,
    Shot,
    numbers,
    render,
    short_video,
    tour,
    tour_images,
    walk,
    write_video,
)

pytestmark = pytest.mark.system

PARALLAX = 5.0


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames that move."""
    return short_video(tmp_path_factory.mktemp("video") / "short.avi")


@pytest.fixture(scope="module")
def extracted(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its frames and their motion; tests that write work on a copy."""
    return extract_frames(short, tmp_path_factory.mktemp("frames") / "out")[0].parent


@pytest.fixture(scope="module")
def twelfth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk in which decoding can begin at each twelfth frame."""
    images = [render(shot) for shot in walk([0.12] * 60)]
    return write_video(tmp_path_factory.mktemp("video") / "walk.mp4", images, fourcc="mp4v")


@pytest.fixture
def large_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[Shot]], Path]:
    """Makes a video that counts as a large one; decoding can begin at each twelfth frame."""
    monkeypatch.setattr(streams, "_LARGE", WIDTH)
    return lambda shots: write_video(tmp_path / "walk.mp4", [render(shot) for shot in shots], fourcc="mp4v")


def test_even_baseline_sharp_frames_and_none_at_rest(tmp_path: Path) -> None:
    shots, images = tour(), tour_images()
    video = write_video(tmp_path / "tour.mp4", images, fourcc="mp4v")
    files = extract_frames(video, tmp_path / "out", parallax=PARALLAX)
    chosen = numbers(files)
    steps = np.diff([shots[number].along for number in chosen])
    # In the fast part frames are 0.2 m apart and every third is blurred: the best one may be that far off.
    assert steps.max() / steps.min() < 1.8, steps
    assert 0.6 < steps.mean() < 0.9  # metres: what is seen is 4 to 12 away
    assert sum(45 <= number < 85 for number in chosen) <= 1
    assert not [number for number in chosen if shots[number].blur]
    assert chosen[0] <= 3 and shots[chosen[-1]].along > shots[-1].along - 0.15
    assert [file.name for file in files] == sorted(file.name for file in files)
    assert files[0].name == f"tour_{chosen[0]:06d}.jpg"
    for file, number in zip(files, chosen, strict=True):
        picture = decode(file, cv2.IMREAD_COLOR).astype(int)
        assert picture.shape == (HEIGHT, WIDTH, 3)
        around = range(max(0, number - 2), min(number + 3, len(shots)))
        errors = [np.abs(picture - images[it]).mean() for it in around]
        assert min(errors) == np.abs(picture - images[number]).mean()


def test_a_standing_camera_gives_no_scene(tmp_path: Path) -> None:
    shots = [Shot(0.01 * np.sin(it), (0.3 * it, 0.0, 0.0)) for it in range(12)]
    video = write_video(tmp_path / "still.avi", [render(shot) for shot in shots])
    with pytest.raises(InputError, match=r"still\.avi: the camera moves by less than 4 degrees"):
        extract_frames(video, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_goes_on_where_it_was_stopped(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = extract_frames(short, tmp_path / "whole", parallax=PARALLAX, most=100)
    assert len(whole) >= 3
    calls: list[tuple[int, int]] = []

    def stop(done: int, total: int) -> None:
        calls.append((done, total))
        if done == 8 + numbers(whole)[1] + 1:  # the second frame has just been written
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        extract_frames(short, out, parallax=PARALLAX, most=100, progress=stop)
    assert calls == [(n, 16) for n in range(1, 9)] + [
        (9 + number, 9 + numbers(whole)[-1]) for number in numbers(whole)[:2]
    ]
    kept = {path: path.stat().st_mtime_ns for path in sorted(out.glob("*.jpg"))}
    assert [path.name for path in kept] == [path.name for path in whole[:2]]
    assert not list(out.glob(f".*{SUFFIX}"))
    monkeypatch.setattr(module, "search", None)  # the motion is known
    (out / f".short_000001.jpg.1234{SUFFIX}").write_bytes(b"of a killed writer")
    again = extract_frames(short, out, parallax=PARALLAX, most=100)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in whole]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        path.name for path in (tmp_path / "whole").iterdir()
    )
    monkeypatch.setattr(module, "open_video", None)  # all is there
    assert extract_frames(short, out, parallax=PARALLAX, most=100) == again


@pytest.mark.parametrize("large", [False, True])
def test_chosen_frames_are_written_while_their_video_is_followed(
    large: bool, twelfth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All but one or two at the ends, with the bytes that decoding again gives, as where a limit is given."""
    monkeypatch.setattr(streams, "_LARGE", WIDTH + (not large))
    again = extract_frames(twelfth, tmp_path / "again", most=1000)
    sought: list[float] = []
    original = Video.frames_at

    def frames_at(self: Video, times: Sequence[float], keys: Sequence[float]) -> Iterator[float]:
        sought.extend(times)
        return original(self, times, keys)

    monkeypatch.setattr(Video, "frames_at", frames_at)
    files = extract_frames(twelfth, tmp_path / "out")
    assert len(files) > 6 and len(sought) <= 2
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "again").iterdir())
    assert [path.read_bytes() for path in files] == [path.read_bytes() for path in again]


def test_goes_on_after_a_stop_while_the_video_was_followed(twelfth: Path, tmp_path: Path) -> None:
    whole, out = extract_frames(twelfth, tmp_path / "whole"), tmp_path / "out"

    def stop(done: int, total: int) -> None:
        if out.exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_frames(twelfth, out, progress=stop)
    (kept,) = out.iterdir()
    assert kept.suffix == SUFFIX
    with pytest.raises(KeyboardInterrupt):  # at once: what is left of a killed process takes no room
        extract_frames(
            twelfth, out, progress=lambda done, total: stop(done, total) if not kept.exists() else None
        )
    assert [path.read_bytes() for path in extract_frames(twelfth, out)] == [it.read_bytes() for it in whole]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        path.name for path in (tmp_path / "whole").iterdir()
    )


def test_what_was_written_of_a_video_that_turns_out_to_be_damaged_is_not_used(
    twelfth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = bytearray(twelfth.read_bytes())
    data[len(data) * 3 // 4 : len(data) * 3 // 4 + 400] = bytes(400)
    for name in ("early", "late"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "walk.mp4").write_bytes(data)
    early, late = (
        extract_frames(tmp_path / name / "walk.mp4", tmp_path / name / "out", most=most)
        for name, most in (("early", None), ("late", 1000))
    )
    assert [path.read_bytes() for path in early] == [path.read_bytes() for path in late]
    assert not list((tmp_path / "early" / "out").glob(f".*{SUFFIX}"))


def test_frames_that_seeking_does_not_find_are_read_in_order(
    short: Path, extracted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Video, "frames_at", lambda self, times, keys: iter(times[:0]))
    files = extract_frames(short, tmp_path / "out")
    assert [file.read_bytes() for file in files] == [(extracted / file.name).read_bytes() for file in files]


def test_of_a_large_video_that_moves_slowly_few_frames_are_looked_at(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And as many as before where the camera is faster."""
    slow = write_video(tmp_path / "slow.avi", [render(shot) for shot in walk([0.004] * 30)])
    for video in (short, slow):
        monkeypatch.setattr(streams, "_LARGE", WIDTH + 1)
        every = search(video, "", no_progress, None, None, fine=True)
        monkeypatch.setattr(streams, "_LARGE", WIDTH)
        some = search(video, "", no_progress, None, None, fine=True)
        (all_, few) = (sum(len(piece.frames) for piece in it.pieces) for it in (every, some))
        assert few == all_ if video == short else few < 0.5 * all_
        ends = [max(piece.positions[-1] for piece in it.pieces) for it in (every, some)]
        assert ends[1] == pytest.approx(ends[0], abs=0.3)


def test_of_a_large_video_frames_between_those_to_seek_are_decoded_where_these_are_far_apart(
    large_video: Callable[[Sequence[Shot]], Path], tmp_path: Path
) -> None:
    """Decoding can begin at each twelfth frame; the camera is slow, for 24 frames fast, and slow again."""
    shots = walk([0.03] * 36 + [0.3] * 24 + [0.03] * 40)
    video = large_video(shots)
    few, every = (search(video, "", no_progress, None, None, fine=fine) for fine in (False, True))
    assert (few.coarse, every.coarse) == (True, False)
    (coarse,), (whole,) = few.pieces, every.pieces
    assert [number for number in coarse.frames if number <= 36 or 60 <= number < 96] == [
        *range(0, 37, 12),
        *range(60, 96, 12),
    ]
    assert len([number for number in coarse.frames if 36 < number < 60]) > 12
    assert min(coarse.frames[-1], whole.frames[-1]) >= 96
    for number, position in zip(coarse.frames, coarse.positions, strict=True):
        if number in whole.frames:
            assert position == pytest.approx(whole.positions[whole.frames.index(number)], rel=0.1, abs=0.5)
    out = tmp_path / "out"
    files = extract_frames(video, out)
    steps = np.diff([shots[number].along for number in numbers(files)])
    assert steps.max() < 1.3, steps
    assert len(extract_frames(video, out, parallax=1.0)) > 2 * len(files)  # which requires another search
    assert not (known := load_motion(out / "walk.motion.json")) or not known.coarse


def test_of_a_large_video_frames_before_one_to_seek_are_left_out_once_that_is_near_enough(
    large_video: Callable[[Sequence[Shot]], Path], tmp_path: Path
) -> None:
    """Decoding can begin at each twelfth frame, and between two of these the camera moves by 9 degrees."""
    shots = walk([0.1] * 40)
    video = large_video(shots)
    (piece,) = search(video, "", no_progress, None, None, fine=False).pieces
    assert {0, 12, 24, 36} <= set(piece.frames)
    assert max(number % 12 for number in piece.frames if number < 36) <= 7
    assert 2.5 < max(np.diff(piece.positions)) <= 6
    steps = np.diff([shots[number].along for number in numbers(extract_frames(video, tmp_path / "out"))])
    assert steps[:-1].max() / steps[:-1].min() < 1.8, steps  # the last one ends where the video does


def test_of_a_large_video_that_stands_blurred_frames_to_seek_are_no_obstacle(
    large_video: Callable[[Sequence[Shot]], Path], tmp_path: Path
) -> None:
    shots = walk([0.0] * 26 + [0.1] * 24)
    shots = [
        replace(shot, turn=(0.0, 0.0, 0.0), blur=4.0 * (n in (12, 24, 36))) for n, shot in enumerate(shots)
    ]
    video = large_video(shots)
    found = search(video, "", no_progress, None, None, fine=False)
    assert found.coarse and len(found.pieces) == 1
    files = extract_frames(video, tmp_path / "out")
    assert not {12, 24, 36}.intersection(numbers(files))
    assert sum(number < 26 for number in numbers(files)) == 1 and len(files) > 3


def test_a_large_video_that_is_fast_from_its_begin_has_the_true_numbers_of_frames(
    large_video: Callable[[Sequence[Shot]], Path], tmp_path: Path
) -> None:
    """Where the file of motion had a number twice it was unsound, and each call followed the video anew."""
    video = large_video(walk([0.3] * 30))
    files = extract_frames(video, tmp_path / "out")
    known = load_motion(tmp_path / "out" / "walk.motion.json")
    assert known is not None and known.coarse
    (piece,) = known.pieces
    assert piece.frames == [round(time * 30) for time in piece.times]
    assert extract_frames(video, tmp_path / "out") == files


def test_another_choice_replaces_the_first(short: Path, extracted: Path, tmp_path: Path) -> None:
    shutil.copytree(extracted, tmp_path / "out")
    extract_frames(short, tmp_path / "out", parallax=2.0)
    (tmp_path / "out" / "short_999999.jpg").write_bytes(b"of the user")
    files = extract_frames(short, tmp_path / "out", parallax=2.0, most=2)
    assert len(files) == 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *(file.name for file in files),
        "short.motion.json",
        "short_999999.jpg",
    }


def test_another_video_of_the_same_name_is_refused(extracted: Path, tmp_path: Path) -> None:
    out = shutil.copytree(extracted, tmp_path / "out")
    before = [path.read_bytes() for path in sorted(out.glob("*.jpg"))]
    with pytest.raises(InputError, match="another video of the name short"):
        extract_frames(write_video(tmp_path / "short.avi", tour_images(32, 45, 2)), out)
    assert [path.read_bytes() for path in sorted(out.glob("*.jpg"))] == before


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: b"\xff\xfe",
        lambda text: b"[" * 100_000,
        lambda text: text.replace(b'"version": 3', b'"version": 2'),
        lambda text: text.replace(b'"positions": [0.0', b'"positions": [NaN'),
        lambda text: text.replace(b'"frames": [0', b'"frames": [-1'),
        lambda text: text.replace(b'"decoded": 8', b'"decoded": 1e999'),
        lambda text: text.replace(b'"pieces": [', b'"pieces": [7, '),
    ],
)
def test_a_damaged_file_of_motion_is_none(
    damage: Callable[[bytes], bytes], extracted: Path, tmp_path: Path
) -> None:
    good, file = (extracted / "short.motion.json").read_bytes(), tmp_path / "a.json"
    file.write_bytes(good)
    assert load_motion(file) is not None
    file.write_bytes(damage(good))
    assert file.read_bytes() != good and load_motion(file) is None


def test_what_is_damaged_is_made_anew(short: Path, extracted: Path, tmp_path: Path) -> None:
    out = shutil.copytree(extracted, tmp_path / "out")
    files, file = sorted(out.glob("*.jpg")), out / "short.motion.json"
    good = file.read_bytes()
    file.write_bytes(good[: len(good) // 2])
    assert extract_frames(short, out) == files
    assert file.read_bytes() == good


@pytest.mark.parametrize("bad", [0.0, -1.0, 46.0, float("nan")])
def test_options_out_of_bounds(bad: float, short: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give an angle above 0"):
        extract_frames(short, tmp_path, parallax=bad)
    with pytest.raises(InputError, match="give at least 2"):
        extract_frames(short, tmp_path, most=1)


def test_names_are_safe_and_the_file_is_small(tmp_path: Path) -> None:
    video = write_video(tmp_path / "my walk (1).v2.avi", tour_images(30, 45, 2))
    files = extract_frames(video, tmp_path / "deep" / "out")
    assert files[0].name.startswith("my_walk__1__v2_0000")
    described = json.loads((tmp_path / "deep" / "out" / "my_walk__1__v2.motion.json").read_text())
    assert described["chosen"] == numbers(files)
