"""Raw videos of two lenses: both circles in each frame, two streams, two files."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.orchestrator.cli.session.preparing import settings_of
from panolog.orchestrator.runs.preparation.settings import Options
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sources.find import find_sources
from panolog.prepare.sources.gather import gather
from panolog.prepare.stitching.circles import halves
from panolog.prepare.stitching.lenses import APPROXIMATE
from panolog.prepare.video.decode import open_video
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode_colors, read_info
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.orchestrator.cli.program import call, one_line, shown
from tests.prepare.stitching.cameras import camera, write
from tests.prepare.video.videos import numbers, render, walk

pytestmark = pytest.mark.system

Image = NDArray[np.uint8]
Walked = list[tuple[Image, Image]]
COUNT, SIDE, WIDTH = 10, 320, 720  # frames; pixels of a lens's picture, and of the panoramas in the video


@pytest.fixture(scope="module")
def walked() -> Walked:
    """(H, W, 3) panoramas of a walk, and their two circles side by side."""
    known, views = camera(SIDE), [render(it, WIDTH, bearer=False) for it in walk([0.12] * COUNT)]
    return [(view, known.picture(view, seed)) for seed, view in enumerate(views)]


def raw(kind: str, folder: Path, pictures: list[Image]) -> Path:
    """The video as a camera of that kind writes it; the one to be given."""
    one, other = ([halves(it)[side] for it in pictures] for side in range(2))
    match kind:
        case "both circles":
            return write(folder / "clip.mp4", pictures)
        case "two streams":
            return write(folder / "clip.insv", one, other)
        case "a dark rim below":
            rim = np.zeros((36, 2 * SIDE, 3), np.uint8)
            return write(folder / "clip.mp4", [np.vstack([it, rim]) for it in pictures])
    write(folder / "VID_20260101_000000_10_001.insv", other)
    return write(folder / "VID_20260101_000000_00_001.insv", one)


@pytest.fixture(scope="module")
def card(walked: Walked, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with both files of a video: the lenses of a file are found once."""
    return raw("two files", tmp_path_factory.mktemp("card"), [it for _, it in walked]).parent


def number_of(picture: Image, walked: Walked) -> int:
    """Which frame of the walk a panorama shows, by details that all sizes of it have."""
    small, *views = (
        cv2.resize(it, (256, 128), interpolation=cv2.INTER_AREA).astype(float)
        for it in (picture, *(view for view, _ in walked))
    )
    off = [float(np.abs(small - view).mean()) for view in views]
    assert min(off) < 14  # a step of the walk makes 19
    return int(np.argmin(off))


@pytest.mark.parametrize("kind", ["two streams", "two files"])
def test_frames_are_those_of_the_panorama(kind: str, walked: Walked, card: Path, tmp_path: Path) -> None:
    pictures = [it for _, it in walked]
    path = card / "VID_20260101_000000_00_001.insv" if kind == "two files" else raw(kind, tmp_path, pictures)
    with open_video(path) as video:
        assert 1.75 * SIDE < video.width <= 2 * SIDE and video.height * 2 == video.width
        for number in video.frames():
            picture = video.picture()
            assert picture is not None and picture.shape == (video.height, video.width, 3)
            assert number_of(picture, walked) == number
            grey = video.grey(300)
            assert grey is not None and grey.shape == (150, 300)
        assert video.decoded == COUNT and video.notes() == [f"{path}: {APPROXIMATE}"]


def test_raw_files_go_with_panoramas_and_with_each_other(walked: Walked, card: Path, tmp_path: Path) -> None:
    photographs, stitched, several = tmp_path / "photographs", tmp_path / "stitched", 2
    for folder in (photographs, stitched):
        folder.mkdir()
    for number, (panorama, picture) in enumerate(walked[:: COUNT // several]):
        cv2.imwrite(str(photographs / f"{number}.jpg"), picture)
        (photographs / f"{number}.jpg").rename(photographs / f"{number}.insp")
        cv2.imwrite(str(stitched / f"{number}.png"), panorama)
    sources = find_sources([card, photographs, stitched])
    found = gather(sources, tmp_path / "work", SfmSettings(), no_progress)
    labels = [panorama.source for panorama in found.panoramas]
    assert labels.count("photographs") == labels.count("stitched") == several
    frames = [it.path for it in found.panoramas if it.source == "VID_20260101_000000_00_001"]
    chosen = numbers(frames)
    assert len(chosen) == len(labels) - 2 * several >= 3 and (chosen[0], chosen[-1]) == (0, COUNT - 1)
    assert number_of(decode_colors(frames[1]), walked) == chosen[1]
    sizes = {(info.width, info.height) for info in (read_info(it.path) for it in found.panoramas)}
    assert sizes == {(walked[0][0].shape[1], walked[0][0].shape[0])}  # that of the widest
    assert sum(note.endswith(APPROXIMATE) for note in found.notes) == 2
    assert found.left_out == ()


def test_the_command_takes_videos(walked: Walked, tmp_path: Path) -> None:
    path, out = raw("a dark rim below", tmp_path, [it for _, it in walked]), tmp_path / "out"
    printed = shown("scene", "stitch", path, "-o", out, "--frames", "3")
    made = sorted(out.glob("clip_*.jpg"))
    chosen = numbers(made)
    assert printed["panoramas"] == 3 == len(made) and (chosen[0], chosen[-1]) == (0, COUNT - 1)
    assert number_of(decode_colors(made[1]), walked) == chosen[1]
    assert json.loads((out / "lenses.json").read_bytes())[0]["size"] == [SIDE, SIDE + 36]
    again = one_line(call("scene", "stitch", path, "-o", out, "--frames", "3", "--up", "right"))
    assert "is about another video of the name clip, or of another --up" in again
    flat = write(tmp_path / "flat.mp4", [it for it, _ in walked[:3]])
    assert "shows no two fisheye circles" in one_line(call("scene", "stitch", flat, "-o", tmp_path / "no"))


def test_one_lens_of_two_files_is_refused(walked: Walked, tmp_path: Path) -> None:
    path = raw("two files", tmp_path, [it for _, it in walked[:4]])
    path.with_name(path.name.replace("_00_", "_10_")).unlink()
    with pytest.raises(InputError, match=r"320 x 320 pixels are not 2:1; stitch it"), open_video(path):
        pass


def test_circles_of_different_places_are_refused(walked: Walked, tmp_path: Path) -> None:
    known, noise = camera(SIDE), np.random.default_rng(1)
    small = noise.integers(40, 220, (4, 24, 48, 3), np.uint8)
    views = [np.asarray(cv2.resize(it, (WIDTH, WIDTH // 2)), np.uint8) for it in small]
    others = [np.asarray(cv2.flip(it, 0), np.uint8) for it in views]
    pictures = [
        np.hstack([halves(known.picture(one))[0], halves(known.picture(other))[1]])
        for one, other in zip(views, others, strict=True)
    ]
    with pytest.raises(InputError, match=r"clip\.mp4: its two fisheye circles cannot be stitched"):
        open_video(write(tmp_path / "clip.mp4", pictures)).__enter__()


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["video", "folder"])
def test_raw_files_become_a_scene_in_one_command(kind: str, walked: Walked, tmp_path: Path) -> None:
    source = tmp_path / "raw"
    if kind == "video":
        source = raw("both circles", tmp_path, [it for _, it in walked])
    else:
        source.mkdir()
        for number, (_, picture) in enumerate(walked[::4]):
            file = source / f"{number}.jpg"
            cv2.imwrite(str(file), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
            file.rename(file.with_suffix(".insp"))
    settings = settings_of(source, Options())
    assert settings is not None and settings.video == (kind == "video")
    make_scene(source, tmp_path / "scene", SfmSettings(), no_progress)
    scene = read_scene(tmp_path / "scene")
    assert scene.width == settings.width and len(scene.panoramas) >= 3
    centers = scene.centers
    along = centers @ np.linalg.svd(centers - centers.mean(axis=0))[2][0]
    steps = np.diff(along)
    assert (np.sign(steps) == np.sign(steps[0])).all()  # in order along a line, as the camera has walked
    assert json.loads((tmp_path / "scene" / "sfm.json").read_bytes())["left_out"] == []
