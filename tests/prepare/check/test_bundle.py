"""Bundle adjustment of scenes whose cameras were moved: what it finds, and what it leaves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.check.bundle import POSES_OFF, adjust
from panolog.prepare.check.evidence import Tracks, project
from panolog.prepare.check.residuals import measure_residuals
from panolog.renderer.motion import moved
from panolog.scene.colmap import ColmapImage
from panolog.scene.colmap_files import EQUIRECTANGULAR, ColmapCamera
from panolog.scene.model import Panorama, Scene

WIDTH, VIEWS, POINTS = 1024, 8, 300
CAMERA = ColmapCamera(1, EQUIRECTANGULAR, WIDTH, WIDTH // 2, (float(WIDTH), WIDTH / 2))
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])  # not read here


def walk(noise: float) -> tuple[Scene, Tracks]:
    """Cameras on a straight line, whose common turn about it only their rotations show; noise in pixels."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-6, -3, -4), (16, 3, 4), (POINTS, 3))
    panoramas, tracks = [], {}
    for number in range(VIEWS):
        rotation = moved(np.eye(3), np.zeros(3), np.concatenate([np.zeros(3), rng.normal(size=3)]))[0]
        translation = -rotation @ np.array([1.5 * number, 0.0, 0.0])
        seen = np.flatnonzero(rng.random(POINTS) < 0.6) if number < VIEWS - 1 else np.arange(4)
        pixels = (
            project(points[seen] @ rotation.T + translation) * WIDTH + rng.normal(size=(len(seen), 2)) * noise
        )
        name = f"{number}.png"
        panoramas.append(Panorama(name, Path(name), rotation, translation, seen))
        tracks[name] = ColmapImage(name, CAMERA, rotation, translation, seen, seen, pixels, UNTURNED)
    rows = tuple(range(VIEWS))
    scene = Scene(
        Path(), WIDTH, WIDTH // 2, tuple(panoramas), points, np.zeros((POINTS, 3), np.uint8), rows, (), ""
    )
    return scene, tracks


def disturbed(scene: Scene, shift: float, turn: float) -> Scene:
    rng, panoramas = np.random.default_rng(1), []
    for panorama in scene.panoramas:
        motion = np.concatenate([rng.normal(size=3) * shift, rng.normal(size=3) * np.radians(turn)])
        rotation, translation = moved(panorama.rotation, panorama.translation, motion)
        panoramas.append(replace(panorama, rotation=rotation, translation=translation))
    return replace(scene, panoramas=tuple(panoramas))


def apart(one: Scene, other: Scene) -> tuple[float, float]:
    """World units and radians of the cameras with tracks, root mean square, without any alignment."""
    rows = list(range(VIEWS - 1))
    shifts = np.linalg.norm(one.centers[rows] - other.centers[rows], axis=1)
    turns = [
        np.linalg.norm(one.panoramas[row].rotation - other.panoramas[row].rotation) / np.sqrt(2)
        for row in rows
    ]
    return float(np.sqrt((shifts**2).mean())), float(np.sqrt(np.mean(np.square(turns))))


def test_moved_cameras_return_in_the_frame_that_they_had() -> None:
    truth, tracks = walk(noise=0.2)
    wrong = disturbed(truth, shift=0.05, turn=0.3)
    found = adjust(wrong, tracks)
    right = found.applied(wrong)
    before, after = apart(wrong, truth), apart(right, truth)
    # What stays is the mean of all errors, which no observation shows.
    assert after[0] < 0.6 * before[0] and after[1] < 0.6 * before[1]
    assert np.nanmedian(found.after) < 0.3 and np.nanmedian(found.before) > 1
    assert found.gain > POSES_OFF
    assert np.array_equal(found.after, measure_residuals(right, tracks), equal_nan=True)
    steps = np.linalg.norm(np.diff(right.centers[: VIEWS - 1], axis=0), axis=1)
    assert steps / steps.mean() == pytest.approx(1, abs=0.01)
    again = adjust(wrong, tracks)
    assert again.poses.tobytes() == found.poses.tobytes() and again.points.tobytes() == found.points.tobytes()


def test_true_poses_stay() -> None:
    truth, tracks = walk(noise=0.2)
    found = adjust(truth, tracks)
    shift, turn = apart(found.applied(truth), truth)
    assert turn * WIDTH / (2 * np.pi) < 0.1 and shift < 0.005
    assert found.gain < POSES_OFF


def test_a_few_wrong_observations_do_not_bend_it() -> None:
    truth, tracks = walk(noise=0.2)
    rng = np.random.default_rng(3)
    damaged = {}
    for name, image in tracks.items():
        pixels = image.pixels.copy()
        some = rng.random(len(pixels)) < 0.05
        pixels[some] = rng.uniform(size=(int(some.sum()), 2)) * (WIDTH, WIDTH / 2)
        damaged[name] = replace(image, pixels=pixels)
    shift, turn = apart(adjust(truth, damaged).applied(truth), truth)
    assert turn * WIDTH / (2 * np.pi) < 0.2 and shift < 0.01


def test_without_common_points_nothing_moves() -> None:
    truth, tracks = walk(noise=0.2)
    alone = {"0.png": tracks["0.png"]}
    found = adjust(truth, alone)
    assert apart(found.applied(truth), truth) == pytest.approx((0, 0), abs=1e-9)
    assert found.gain == pytest.approx(1)
