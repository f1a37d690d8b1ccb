"""A city of any size and a drive through it."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.synthetic.__main__ import main
from panolog.synthetic.city import STEP, city, drive, size
from panolog.synthetic.district import PITCH
from panolog.synthetic.make import make_city
from panolog.synthetic.shapes import Shape
from panolog.synthetic.trace import PanoramaRays, PointRays, Spheres, cast

SIZES = (75, 300, 1200)


@pytest.fixture(scope="module")
def shapes() -> list[Shape]:
    return city(4, 3, 0)


@pytest.fixture(scope="module")
def centers() -> NDArray[np.float64]:
    return drive(4, 3, 300, 0)[1]


@pytest.mark.parametrize("panoramas", SIZES)
def test_panoramas_are_equally_dense_in_all_streets_of_cities_of_any_size(panoramas: int) -> None:
    columns, rows = size(panoramas)
    _, centers = drive(columns, rows, panoramas, 0)
    half = np.array([columns, rows]) * PITCH / 2
    assert (np.abs(centers[:, :2]) < half + 1).all()
    from_street = (centers[:, :2] + half + PITCH / 2) % PITCH - PITCH / 2
    streets = np.round((centers[:, :2] + half) / PITCH)
    seen = set()
    for axis in (0, 1):  # away from crossings
        on = (np.abs(from_street[:, axis]) < 0.8) & (np.abs(from_street[:, 1 - axis]) > 3)
        parts = np.floor((centers[on, 1 - axis] + half[1 - axis]) / PITCH)
        seen |= {(axis, *part) for part in zip(streets[on, axis], parts, strict=True)}
    assert len(seen) == (rows + 1) * columns + (columns + 1) * rows
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert 0.85 * STEP < np.median(steps) < 1.15 * STEP


def test_a_drive_is_upright_and_looks_ahead() -> None:
    rotations, centers = drive(3, 2, 200, 1)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    assert (rotations[:, 1, 2] < -0.99).all()
    steps = np.diff(centers, axis=0)
    short = np.linalg.norm(steps, axis=1) < 1.5 * STEP
    ahead = (rotations[1:, 2] * steps).sum(axis=1) / np.linalg.norm(steps, axis=1)
    assert (ahead[short] > 0.95).all() and short.mean() > 0.9


def test_nothing_is_around_a_camera(shapes: list[Shape], centers: NDArray[np.float64]) -> None:
    random = np.random.default_rng(0)
    directions = random.normal(size=(400, 3))
    for center in centers[::15]:
        rays = PointRays(center + directions / np.linalg.norm(directions, axis=1, keepdims=True), center)
        assert cast(shapes, rays).distance.min() > 0.5


def test_a_block_looks_the_same_in_every_city(shapes: list[Shape]) -> None:
    """The one in the lower left corner, seen from its corner."""
    larger = city(6, 5, 0)
    seen = []
    for solids, half in ((shapes, (2, 1.5)), (larger, (3, 2.5))):
        center = np.array([3.0 - half[0] * PITCH, 3.0 - half[1] * PITCH, 2.0])
        points = center + [[9.0, 9.0, z] for z in np.linspace(-1, 6, 40)]
        seen.append(cast(solids, PointRays(points, center)).distance)
    np.testing.assert_allclose(seen[0], seen[1], rtol=1e-4)


def test_districts_differ(shapes: list[Shape]) -> None:
    """In the height of what stands at the streets: that of the tallest house of each of the four corners."""
    tall = [shape for shape in shapes if 4 < shape.radius < 12 and shape.center[2] < 9]
    heights = []
    for x in (-1, 1):
        for y in (-1, 1):
            here = [s for s in tall if s.center[0] * x > PITCH and s.center[1] * y > PITCH / 2]
            heights.append(np.median([shape.center[2] for shape in here]))
    assert np.ptp(heights) > 1.5


def test_a_river_lies_below_its_banks_and_is_bridged(shapes: list[Shape]) -> None:
    """It is the second row of blocks, whose middle is y = 0."""

    def level(x: float, y: float) -> float:
        above = np.array([x, y, 50.0])
        return 50 - float(cast(shapes, PointRays(above[None] - [0, 0, 1], above)).distance[0])

    assert level(PITCH / 2, 0) == pytest.approx(-2.4, abs=0.01)
    assert level(PITCH / 2, 14.5) == pytest.approx(0, abs=0.01)
    assert all(level(column * PITCH, 1.0) == pytest.approx(0, abs=0.01) for column in range(-2, 3))


@pytest.mark.parametrize("index", [0, 61, 170, 240])
def test_leaving_out_what_is_hidden_or_small_changes_hardly_a_ray(
    shapes: list[Shape], centers: NDArray[np.float64], index: int
) -> None:
    rays = PanoramaRays(np.eye(3), centers[index], 64, 3)
    spheres = Spheres(shapes)
    every = cast(shapes, rays)
    ordered = cast(shapes, rays, spheres.seen(centers[index], 0.0))
    np.testing.assert_array_equal(ordered.distance, every.distance)
    coarse = cast(shapes, rays, spheres.seen(centers[index], np.pi / 512))
    assert (coarse.distance != every.distance).mean() < 0.001


def test_a_panorama_tries_a_small_part_of_a_large_city() -> None:
    blocks = size(1200)
    shapes, (_, centers) = city(*blocks, 0), drive(*blocks, 1200, 0)
    tried = [count_tried(shapes, center) for center in centers[107::360]]
    assert np.mean(tried) < 0.25 * len(shapes)


def count_tried(shapes: list[Shape], center: NDArray[np.float64]) -> int:
    """How many shapes are compared with rays."""
    rays, order = PanoramaRays(np.eye(3), center, 256, 1), Spheres(shapes).seen(center, np.pi / 512)
    found = cast(shapes, rays, order).distance
    windows = [rays.near(shapes[index].center, shapes[index].radius) for index, _ in order]
    pairs = zip(windows, order, strict=True)
    return sum(bool((found[rows] > nearest).any()) for rows, (_, nearest) in pairs)


@pytest.mark.parametrize("flight", [False, True])
def test_a_city_is_a_scene_with_the_same_bytes_each_time(tmp_path: Path, *, flight: bool) -> None:
    digests = []
    for name in ("a", "b"):
        folder = make_city(tmp_path / name, panoramas=8, width=64, points=300, flight=flight)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        digests.append([sha256(path.read_bytes()).hexdigest() for path in files])
    assert digests[0] == digests[1]
    scene = read_scene(folder)
    assert [panorama.name for panorama in scene.panoramas] == [f"city_{i:03d}.png" for i in range(8)]
    assert (scene.centers[:, 2] > 20).sum() == (2 if flight else 0)
    observed = [panorama.observed for panorama in scene.panoramas]
    assert all(len(rows) for rows in observed[:6])
    for center, rows in zip(scene.centers, observed, strict=True):
        assert np.linalg.norm(scene.points[rows] - center, axis=1).max(initial=0) < 61


def test_a_city_of_one_panorama_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="1 panoramas cannot be reconstructed"):
        make_city(tmp_path / "city", panoramas=1)
    assert main(["city", str(tmp_path / "city"), "--panoramas", "1"]) == 2
    assert "give 2 or more" in capsys.readouterr().err
    assert not (tmp_path / "city").exists()
