"""From panoramas to scenes: a rendered street with known poses, and real places."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm import pairs
from panolog.prepare.sfm.pipeline import (
    SfmSettings,
    make_scene,
    panoramas_in_folder,
    workspace_folder,
)
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import drift
from tests.prepare.video.containers import add_spherical, add_track, equirectangular
from tests.prepare.video.sensors import gps5, grav, payload
from tests.prepare.video.videos import Shot, render, walk, write_video

pytestmark = pytest.mark.system

Array = NDArray[np.float64]
WIDTH = 640


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Shot]]:
    """Panoramas of a street with walls of random patches; the operator is in all of them."""
    folder = tmp_path_factory.mktemp("street")
    shots = walk([0.9] * 7)
    (folder / "images").mkdir()
    for number, shot in enumerate(shots):
        cv2.imwrite(str(folder / "images" / f"pano {number}.png"), render(shot, WIDTH))
    return folder, shots


@pytest.fixture(scope="module")
def featured(street: tuple[Path, list[Shot]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The workspace of the street with its features, from a job that was interrupted before matching."""
    return _interrupted(street[0], tmp_path_factory.mktemp("featured") / "scene", "matches")


@pytest.fixture(scope="module")
def matched(
    street: tuple[Path, list[Shot]], featured: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The same with the matches of all pairs."""
    return _interrupted(street[0], tmp_path_factory.mktemp("matched") / "scene", "poses", begun=featured)


def test_poses_are_those_of_the_street(
    street: tuple[Path, list[Shot]], matched: Path, tmp_path: Path
) -> None:
    folder, shots = street
    made = _make(folder, tmp_path / "scene", begun=matched)
    scene = read_scene(tmp_path / "scene")
    assert [panorama.name for panorama in scene.panoramas] == [f"pano {number}.png" for number in range(7)]
    assert not workspace_folder(tmp_path / "scene").exists()
    truth = np.array([[0, 0, shot.along] for shot in shots])
    assert drift(scene.centers, truth) < 0.01 * np.ptp(truth)
    spread = np.ptp(scene.centers, axis=0)
    assert made.world.frame == "upright"
    assert spread[2] < 0.05 * spread.max()  # z is up, but for the mean sway of the camera
    assert len(made.found.missing) == 0
    errors = np.concatenate(made.found.model.errors(WIDTH))
    assert errors.mean() < 0.5


def test_panoramas_in_webp(street: tuple[Path, list[Shot]], tmp_path: Path) -> None:
    folder, _ = street
    (tmp_path / "images").mkdir()
    for number in range(3):
        picture = cv2.imread(str(folder / "images" / f"pano {number}.png"))
        assert picture is not None
        path = tmp_path / "images" / f"pano {number}.{'WEBP' if number else 'webp'}"
        path.write_bytes(bytes(cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, 101])[1]))
    _make(tmp_path, tmp_path / "scene")
    scene = read_scene(tmp_path / "scene")
    assert len(scene.panoramas) == 3
    assert scene.panoramas[0].image.suffix == ".webp"


def test_an_image_that_colmap_cannot_read_is_one_clear_line(
    street: tuple[Path, list[Shot]], tmp_path: Path
) -> None:
    folder, _ = street
    shutil.copytree(folder / "images", tmp_path / "images")
    picture = cv2.imread(str(folder / "images" / "pano 3.png"))
    assert picture is not None
    (tmp_path / "images" / "pano 3.png").write_bytes(bytes(cv2.imencode(".webp", picture)[1]))
    with pytest.raises(InputError, match=r"pano 3\.png: COLMAP cannot read this image; save it as"):
        _make(tmp_path, tmp_path / "scene")


def test_nothing_is_seen_under_a_mask(street: tuple[Path, list[Shot]], tmp_path: Path) -> None:
    folder, _ = street
    masked = tmp_path / "masked"
    shutil.copytree(folder, masked)
    (masked / "masks").mkdir()
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 4] = 0
    for number in range(7):
        cv2.imwrite(str(masked / "masks" / f"pano {number}.png"), mask)
    made = _make(masked, tmp_path / "scene")
    seen = np.concatenate([where for _, where in made.found.model.sightings])
    assert len(seen) > 500
    assert seen[:, 0].min() >= 0.25
    scene = read_scene(tmp_path / "scene")
    assert all(panorama.mask is not None for panorama in scene.panoramas)


def test_a_known_distance_makes_metres(
    street: tuple[Path, list[Shot]], matched: Path, tmp_path: Path
) -> None:
    folder, shots = street
    metres = shots[-1].along - shots[0].along
    settings = SfmSettings(distance=("pano 0.png", "pano 6.png", metres))
    made = _make(folder, tmp_path / "scene", settings, begun=matched)
    centers = read_scene(tmp_path / "scene").centers
    assert made.world.metric
    assert np.linalg.norm(centers[3] - centers[0]) == pytest.approx(shots[3].along - shots[0].along, rel=0.01)


def test_a_video_becomes_a_scene(tmp_path: Path) -> None:
    shots = walk([0.2] * 26)
    video = write_video(tmp_path / "walk.avi", [render(shot, WIDTH) for shot in shots])
    _make(video, tmp_path / "scene", SfmSettings(frames=6))
    scene = read_scene(tmp_path / "scene")
    numbers = [int(panorama.stem.rsplit("_", 1)[1]) for panorama in scene.panoramas]
    truth = np.array([[0, 0, shots[number].along] for number in numbers])
    assert 4 <= len(numbers) <= 6
    assert drift(scene.centers, truth) < 0.02 * np.ptp(truth)


def test_a_video_with_gps_and_gravity_becomes_a_scene_in_metres_upright(tmp_path: Path) -> None:
    shots = [replace(shot, turn=(shot.turn[0], 12.0, shot.turn[2])) for shot in walk([0.2] * 26)]
    video = write_video(tmp_path / "walk.mp4", [render(shot, WIDTH) for shot in shots], fourcc="mp4v")
    metres, step = 20.0, 1_000 // 30  # of a step of the street; milliseconds
    places = [np.array([47.0 + metres * shot.along / 111_000, 8.0, 400.0]) for shot in shots]
    ups = [-Rotation.from_euler("YXZ", shot.turn, degrees=True).as_matrix()[1] for shot in shots]
    samples = [
        (number * step, payload(gps5(place[None]), grav(up[None])))
        for number, (place, up) in enumerate(zip(places, ups, strict=True))
    ]
    add_track(video, b"gpmd", samples, len(samples) * step)
    made = _make(video, tmp_path / "scene", SfmSettings(frames=6))
    scene = read_scene(tmp_path / "scene")
    assert made.world.frame == "enu" and made.world.up.source == "files"
    numbers = [int(panorama.stem.rsplit("_", 1)[1]) for panorama in scene.panoramas]
    north = metres * np.array([shots[number].along for number in numbers])
    truth = np.stack([0 * north, north, 0 * north], axis=1)
    off = scene.centers - truth
    assert np.abs(off - off.mean(axis=0)).max() < 0.03 * np.ptp(north)
    assert made.world.gps is not None
    assert made.world.gps.fixes.origin.latitude == pytest.approx(47, abs=0.01)


def test_a_cropped_video_becomes_a_scene_with_masks(tmp_path: Path) -> None:
    shots, rows = (
        walk([0.4] * 12),
        slice(WIDTH // 16, 3 * WIDTH // 8),
    )  # without an eighth above, a quarter below
    images = [np.ascontiguousarray(render(shot, WIDTH)[rows]) for shot in shots]
    video = write_video(tmp_path / "walk.mp4", images, fourcc="mp4v")
    add_spherical(video, equirectangular(0.0, 0.125, 0.0, 0.25))
    _make(video, tmp_path / "scene", SfmSettings(frames=6))
    scene = read_scene(tmp_path / "scene")
    numbers = [int(panorama.stem.rsplit("_", 1)[1]) for panorama in scene.panoramas]
    truth = np.array([[0, 0, shots[number].along] for number in numbers])
    assert drift(scene.centers, truth) < 0.02 * np.ptp(truth)
    assert (scene.width, scene.height) == (WIDTH, WIDTH // 2)
    for panorama in scene.panoramas:
        assert panorama.mask is not None
        mask = cv2.imread(str(panorama.mask), cv2.IMREAD_UNCHANGED)
        assert mask is not None and (mask[rows] == 255).all() and mask.sum() == 255 * mask[rows].size


def test_many_are_matched_in_order_and_by_looks(
    street: tuple[Path, list[Shot]], featured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, shots = street
    monkeypatch.setattr(pairs, "_OVERLAP", 1)
    monkeypatch.setattr(pairs, "_ALIKE", 3)
    monkeypatch.setattr(pairs, "_WORDS", 512)
    monkeypatch.setattr(pairs, "_WORD_SAMPLES", 20_000)
    made = _make(folder, tmp_path / "scene", SfmSettings(pairing="sequential"), begun=featured)
    assert 6 < made.found.pairs < 7 * 6 / 2  # more than neighbours, fewer than all
    truth = np.array([[0, 0, shot.along] for shot in shots])
    assert drift(read_scene(tmp_path / "scene").centers, truth) < 0.01 * np.ptp(truth)


@pytest.mark.parametrize("when", ["matches", "poses"])
def test_what_is_done_is_not_done_again(
    when: str,
    street: tuple[Path, list[Shot]],
    featured: Path,
    matched: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, _ = street
    begun = featured if when == "matches" else matched
    assert _interrupted(folder, tmp_path / "scene", when, begun=begun, least=1).is_dir()
    assert not (tmp_path / "scene").exists()

    def refuse(*_: object) -> None:
        raise AssertionError("the features were there")

    monkeypatch.setattr("panolog.prepare.sfm.features.features_of", refuse)
    _make(folder, tmp_path / "scene")
    assert len(read_scene(tmp_path / "scene").panoramas) == 7


def test_another_mask_means_other_features(
    street: tuple[Path, list[Shot]], featured: Path, tmp_path: Path
) -> None:
    folder, _ = street
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    _interrupted(copy, tmp_path / "scene", "matches", begun=featured)
    (copy / "masks").mkdir()
    for number in range(7):
        cv2.imwrite(str(copy / "masks" / f"pano {number}.png"), np.zeros((WIDTH // 2, WIDTH), np.uint8))
    with pytest.raises(InputError, match="no features"):
        _make(copy, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    "what, message",
    [
        ("nothing", "there is no such folder or video"),
        ("one", "1 panoramas"),
        ("flat", "not 2:1"),
        ("sizes", "all panoramas must have one size"),
        ("damaged", "truncated"),
        ("taken", "already exists"),
    ],
)
def test_refusals(what: str, message: str, tmp_path: Path) -> None:
    folder, output = tmp_path / "images", tmp_path / "scene"
    shapes = {"one": [(64, 128)], "flat": [(64, 128), (64, 100)], "sizes": [(64, 128), (32, 64)]}
    if what != "nothing":
        _pictures(folder, shapes.get(what, [(64, 128), (64, 128)]))
    if what == "damaged":
        (folder / "1.png").write_bytes((folder / "1.png").read_bytes()[:80])
    if what == "taken":
        output.mkdir()
        (output / "mine").touch()
    with pytest.raises(InputError, match=message):
        _make(folder, output)
    assert sorted(path.name for path in output.rglob("*")) == (["mine"] if what == "taken" else [])


@pytest.mark.parametrize("folder", ["place", "place/images"])
def test_where_pictures_and_masks_are(folder: str, tmp_path: Path) -> None:
    (tmp_path / "place").mkdir()
    _pictures(tmp_path / "place" / "images", [(64, 128)] * 2)
    _pictures(tmp_path / "place" / "masks", [(64, 128)] * 2)
    panoramas, layers = panoramas_in_folder(tmp_path / folder)
    assert [panorama.name for panorama in panoramas] == ["0.png", "1.png"]
    assert layers["masks"] == [tmp_path / "place" / "masks" / f"{number}.png" for number in range(2)]
    assert layers["depths"] == [None, None]


def test_masks_among_the_pictures(tmp_path: Path) -> None:
    _pictures(tmp_path / "place", [(64, 128)] * 2)
    _pictures(tmp_path / "place" / "masks", [(64, 128)] * 2)
    panoramas, layers = panoramas_in_folder(tmp_path / "place")
    assert [panorama.name for panorama in panoramas] == ["0.png", "1.png"]
    assert layers["masks"] == [tmp_path / "place" / "masks" / f"{number}.png" for number in range(2)]


def test_a_scene_inside_of_its_source(tmp_path: Path) -> None:
    _pictures(tmp_path / "images", [(64, 128)] * 3)
    with pytest.raises(InputError, match="give a folder elsewhere"):
        _make(tmp_path / "images", tmp_path / "images" / "scene")


def test_pictures_of_nothing_are_refused(tmp_path: Path) -> None:
    _pictures(tmp_path / "images", [(64, 128)] * 3)
    with pytest.raises(InputError, match="no features"):
        _make(tmp_path / "images", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def _make(
    source: Path, output: Path, settings: SfmSettings | None = None, *, begun: Path | None = None
) -> SfmReport:
    """Makes a scene; `begun` is the workspace of an interrupted job on the same panoramas to resume."""
    if begun is not None:
        shutil.copytree(begun, workspace_folder(output), symlinks=True)
    return make_scene(source, output, settings or SfmSettings(), no_progress)


def _interrupted(
    source: Path, output: Path, stage: str, *, begun: Path | None = None, least: int = 0
) -> Path:
    """The workspace of a job that is interrupted in a stage, when `least` of its steps are done."""

    def interrupt(what: str, done: int, _: int) -> None:
        if what == stage and done >= least:
            raise KeyboardInterrupt

    if begun is not None:
        shutil.copytree(begun, workspace_folder(output), symlinks=True)
    with pytest.raises(KeyboardInterrupt):
        make_scene(source, output, SfmSettings(), interrupt)
    return workspace_folder(output)


def _pictures(folder: Path, shapes: Sequence[tuple[int, int]]) -> None:
    folder.mkdir()
    for number, shape in enumerate(shapes):
        cv2.imwrite(str(folder / f"{number}.png"), np.full(shape, 90, np.uint8))
