"""From panoramas to a scene: a rendered street, the one place that `make test` reconstructs."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm import sketch
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene, workspace_folder
from panolog.prepare.sfm.report import SfmReport
from panolog.prepare.sfm.sketch import Sketch
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import drift
from tests.prepare.video.containers import add_spherical, add_track, equirectangular
from tests.prepare.video.sensors import gps5, grav, payload
from tests.prepare.video.videos import Shot, render, walk, write_video

pytestmark = pytest.mark.system

WIDTH, COUNT = 512, 7
NAMES = [f"pano {number}.{suffix}" for number, suffix in enumerate(["webp", "WEBP", *["png"] * (COUNT - 2)])]
HIDDEN = WIDTH // 4  # columns under a mask


@dataclass(frozen=True, eq=False)
class Made:
    """The street as a scene, and what two interrupted jobs on it have left."""

    source: Path  # panoramas with masks
    shots: list[Shot]
    featured: Path  # the workspace before matching
    matched: Path  # and before mapping
    settings: SfmSettings
    report: SfmReport
    scene: Scene


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Walls of random patches, and the operator; each job continues where the last one was stopped."""
    source, jobs = tmp_path_factory.mktemp("street"), tmp_path_factory.mktemp("jobs")
    shots = walk([0.9] * COUNT)
    (source / "images").mkdir()
    (source / "masks").mkdir()
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[:, :HIDDEN] = 0
    for name, shot in zip(NAMES, shots, strict=True):
        kind, lossless = Path(name).suffix.lower(), [cv2.IMWRITE_WEBP_QUALITY, 101]
        encoded = cv2.imencode(kind, render(shot, WIDTH), lossless if kind == ".webp" else [])[1]
        (source / "images" / name).write_bytes(bytes(encoded))
        cv2.imwrite(str(source / "masks" / Path(name).with_suffix(".png")), mask)
    output = jobs / "scene"
    _interrupted(source, output, "matches")
    featured = Path(shutil.copytree(workspace_folder(output), jobs / "featured", symlinks=True))
    settings = SfmSettings(distance=(NAMES[0], NAMES[-1], shots[-1].along - shots[0].along))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("panolog.prepare.sfm.features.features_of", None)  # the features are there
        _interrupted(source, output, "poses")
        matched = Path(shutil.copytree(workspace_folder(output), jobs / "matched", symlinks=True))
        _interrupted(source, output, "poses", least=3)
        assert not output.exists()
        report = make_scene(source, output, settings, no_progress)
    assert not workspace_folder(output).exists()
    return Made(source, shots, featured, matched, settings, report, read_scene(output))


def test_poses_are_those_of_the_street_in_metres(street: Made) -> None:
    made, centers = street.report, street.scene.centers
    assert [panorama.name for panorama in street.scene.panoramas] == NAMES
    truth = np.array([[0, 0, shot.along] for shot in street.shots])
    assert drift(centers, truth) < 0.01 * np.ptp(truth)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps == pytest.approx(0.9, rel=0.03)
    assert made.world.frame == "upright" and made.world.metric
    spread = np.ptp(centers, axis=0)
    assert spread[2] < 0.05 * spread.max()  # z is up, but for the mean sway of the camera
    assert len(made.found.missing) == 0 and made.found.contradictions == []
    assert json.loads((street.scene.root / "sfm.json").read_text()) == made.as_json()
    assert cv2.imread(str(street.scene.root / "sfm.png")) is not None
    assert np.concatenate(made.found.model.errors(WIDTH)).mean() < 0.5


def test_nothing_is_seen_under_a_mask(street: Made) -> None:
    seen = np.concatenate([where for _, where in street.report.found.model.sightings])
    assert len(seen) > 500
    assert seen[:, 0].min() >= HIDDEN / WIDTH
    assert all(panorama.mask is not None for panorama in street.scene.panoramas)


def test_features_of_other_masks_are_not_used(street: Made, tmp_path: Path) -> None:
    other = tmp_path / "mask.png"
    cv2.imwrite(str(other), np.zeros((WIDTH // 2, WIDTH), np.uint8))
    for layers, wanted in (({}, COUNT), ({"masks": other}, 0)):
        output = tmp_path / f"scene {wanted}"
        shutil.copytree(street.featured, workspace_folder(output), symlinks=True)
        assert _interrupted(street.source, output, "features", layers=layers) == wanted


def test_neither_an_interruption_nor_who_watches_changes_anything(
    street: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is shown while poses are found grows to all panoramas, upright, where they end up."""
    output, shown = tmp_path / "scene", list[Sketch]()
    shutil.copytree(street.matched, workspace_folder(output), symlinks=True)
    monkeypatch.setattr(sketch, "_PAUSE_S", 0.0)
    monkeypatch.setattr(sketch, "_SHARE", 1e9)
    again = make_scene(street.source, output, street.settings, no_progress, show=shown.append).found.model
    counts = [len(it.names) for it in shown]
    assert counts[:5] == [3, 4, 5, 6, 7] and set(shown[4].names) == set(NAMES)
    assert all(len(it.points) > 20 and not len(it.fixes) for it in shown)
    assert drift(shown[-1].centers, street.scene.centers) < 0.02 * np.ptp(street.scene.centers)
    assert np.ptp(shown[-1].centers[:, 2]) < 0.1 * np.ptp(shown[-1].centers)
    first = street.report.found.model
    assert again.rows == first.rows and len(again.points) == len(first.points)
    assert np.array_equal(again.rotations, first.rotations)
    assert np.array_equal(again.translations, first.translations)
    for (rows, where), (others, there) in zip(again.sightings, first.sightings, strict=True):
        assert np.array_equal(rows, others) and np.array_equal(where, there)


def test_a_cropped_video_with_gps_and_gravity_becomes_a_scene_with_masks_in_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots = [replace(shot, turn=(shot.turn[0], 12.0, shot.turn[2])) for shot in walk([0.4] * 12)]
    rows = slice(WIDTH // 16, 3 * WIDTH // 8)  # without an eighth above, a quarter below
    images = [np.ascontiguousarray(render(shot, WIDTH)[rows]) for shot in shots]
    video = write_video(tmp_path / "walk.mp4", images, fourcc="mp4v")
    add_spherical(video, equirectangular(0.0, 0.125, 0.0, 0.25))
    metres, step = 20.0, 1_000 // 30  # of a metre of the street; milliseconds
    places = [np.array([47.0 + metres * shot.along / 111_000, 8.0, 400.0]) for shot in shots]
    ups = [-Rotation.from_euler("YXZ", shot.turn, degrees=True).as_matrix()[1] for shot in shots]
    samples = [
        (number * step, payload(gps5(place[None]), grav(up[None])))
        for number, (place, up) in enumerate(zip(places, ups, strict=True))
    ]
    add_track(video, b"gpmd", samples, len(samples) * step)
    monkeypatch.setattr(sketch, "_PAUSE_S", 0.0)
    monkeypatch.setattr(sketch, "_SHARE", 1e9)
    shown = list[Sketch]()
    made = make_scene(video, tmp_path / "scene", SfmSettings(frames=6), no_progress, show=shown.append)
    scene = read_scene(tmp_path / "scene")
    first, *_, last = shown
    assert first.names == () and np.ptp(first.fixes[:, 1]) == pytest.approx(metres * 0.4 * 11, rel=0.2)
    assert len(last.fixes) == len(first.fixes) >= len(last.names) >= 4
    apart = np.linalg.norm(last.centers[:, None] - last.fixes, axis=2).min(axis=1)
    assert apart.max() < 0.05 * np.ptp(last.fixes[:, 1])  # in one frame
    numbers = [int(panorama.stem.rsplit("_", 1)[1]) for panorama in scene.panoramas]
    assert 4 <= len(numbers) <= 6
    assert made.world.frame == "enu" and made.world.up.source == "files"
    north = metres * np.array([shots[number].along for number in numbers])
    off = scene.centers - np.stack([0 * north, north, 0 * north], axis=1)
    assert np.abs(off - off.mean(axis=0)).max() < 0.03 * np.ptp(north)
    assert made.world.gps is not None
    assert made.world.gps.fixes.origin.latitude == pytest.approx(47, abs=0.01)
    assert (scene.width, scene.height) == (WIDTH, WIDTH // 2)
    for panorama in scene.panoramas:
        mask = cv2.imread(str(panorama.mask), cv2.IMREAD_UNCHANGED)
        assert mask is not None and (mask[rows] == 255).all() and mask.sum() == 255 * mask[rows].size


def _interrupted(
    source: Path, output: Path, stage: str, least: int = 0, layers: dict[str, Path] | None = None
) -> int:
    """Interrupts a job in a stage, when `least` of its steps are done; returns how many were."""
    steps = []

    def interrupt(what: str, done: int, _: int) -> None:
        if what == stage and done >= least:
            steps.append(done)
            raise KeyboardInterrupt

    def with_masks(panoramas: Sequence[PanoramaFile]) -> list[PanoramaFile]:
        return [replace(it, layers={**it.layers, **(layers or {})}) for it in panoramas]

    with pytest.raises(KeyboardInterrupt):
        make_scene(source, output, SfmSettings(), interrupt, with_masks)
    return steps[0]
