"""A city of any size and a drive through it."""

import os
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.scene.read import read_scene
from panolog.synthetic.city import OVER_TOWERS, STEP, city, drive, plan
from panolog.synthetic.district import PITCH, flight_path
from panolog.synthetic.make import make_city
from panolog.synthetic.shapes import Convex
from panolog.synthetic.trace import PanoramaRays, PointRays, Scenery, cast

pytestmark = pytest.mark.system

STREETS = plan(300)


@pytest.fixture(scope="module")
def scenery() -> Scenery:
    return Scenery(city(STREETS, 0))


@pytest.fixture(scope="module")
def centers() -> NDArray[np.float64]:
    return drive(STREETS, 300, 0)[1]


@pytest.mark.parametrize(("panoramas", "crossings"), [(2, 1), (19, 2), (75, 4), (300, 16), (1200, 64)])
def test_the_area_is_that_of_the_panoramas(panoramas: int, crossings: int) -> None:
    streets = plan(panoramas)
    assert streets.cells.sum() == crossings
    assert np.ptp(streets.cells.shape) <= 1
    metres = sum(np.abs(line[1] - line[0]).sum() for axis in (0, 1) for line in streets.lines(axis))
    assert metres == 2 * PITCH * crossings


@pytest.mark.parametrize("panoramas", [10, 19, 75, 77, 130, 300, 1070, 1200])
def test_all_streets_are_driven_equally_densely(panoramas: int) -> None:
    streets = plan(panoramas)
    _, centers = drive(streets, panoramas, 0)
    gaps = []
    for axis in (0, 1):
        for line in streets.lines(axis):
            low, high = sorted(line[:, axis].tolist())
            on = np.abs(centers[:, 1 - axis] - line[0, 1 - axis]) < 0.8
            along = np.sort(centers[on & (low < centers[:, axis]) & (centers[:, axis] < high), axis])
            assert along.size
            gaps.append(np.diff([low, *along, high]).max())
    assert np.partition(gaps, -2)[:-1].max() < 2.1 * STEP  # where a street crosses another's path; the last
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    jumps = steps > 1.3 * STEP
    assert jumps.sum() < len(gaps) and np.abs(steps[~jumps].mean() - STEP) < 0.03 * STEP
    assert np.partition(steps, -2)[-2] < 1.6 * PITCH  # but from a column that is not full


def test_a_drive_is_upright_and_looks_ahead() -> None:
    rotations, centers = drive(STREETS, 300, 1)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    assert (rotations[:, 1, 2] < -0.99).all()
    steps = np.diff(centers, axis=0)
    length = np.linalg.norm(steps, axis=1)
    ahead = (rotations[1:, 2] * steps).sum(axis=1) / length
    assert (ahead[length < 1.3 * STEP] > 0.95).all()


def test_nothing_is_around_a_camera(scenery: Scenery, centers: NDArray[np.float64]) -> None:
    columns, rows = STREETS.cells.shape
    above = flight_path(columns, rows, 40, 0)[1] + np.array([*STREETS.middle, OVER_TOWERS])
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for center in np.concatenate([centers[::3], above]):
        around = cast(scenery.within(center, 2.0), PointRays(center + directions, center))
        assert around.distance.min() > 0.5
        inside = [
            shape for shape in scenery.within(center, 0) if isinstance(shape, Convex)
            and (shape.normals @ center.astype(np.float32) <= shape.offsets).all()
        ]  # fmt: skip
        assert not inside


@pytest.mark.parametrize(("index", "width"), [(0, 64), (61, 100), (130, 64), (244, 100)])
def test_leaving_out_what_is_hidden_changes_no_ray(
    scenery: Scenery, centers: NDArray[np.float64], index: int, width: int
) -> None:
    rotation = Rotation.random(random_state=index).as_matrix()
    rays = PanoramaRays(rotation, centers[index], width, 1)
    every, culled = cast(scenery.shapes, rays), scenery.cast(rays)
    np.testing.assert_array_equal(culled.distance, every.distance)
    np.testing.assert_array_equal(culled.shape, every.shape)


def test_a_city_is_a_scene_with_the_same_bytes_for_any_number_of_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digests = []
    for name, processors in (("a", 4), ("b", 1)):
        monkeypatch.setattr(os, "cpu_count", lambda count=processors: count)
        folder = make_city(tmp_path / name, panoramas=8, width=64, points=300, flight=True)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        digests.append([sha256(path.read_bytes()).hexdigest() for path in files])
    assert digests[0] == digests[1]
    scene = read_scene(folder)
    assert [panorama.name for panorama in scene.panoramas] == [f"city_{i:03d}.png" for i in range(8)]
    assert (scene.centers[:, 2] > 20).sum() == 2
    observed = [panorama.observed for panorama in scene.panoramas]
    assert all(len(rows) for rows in observed[:6])
    for center, rows in zip(scene.centers, observed, strict=True):
        assert np.linalg.norm(scene.points[rows] - center, axis=1).max(initial=0) < 61
