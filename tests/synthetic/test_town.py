"""The demo's town: does what it writes agree with what it is?"""

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from panolog.scene.colmap import read_panoramas
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.synthetic import make_town
from panolog.synthetic.layout import camera_path
from panolog.synthetic.make import project
from panolog.synthetic.paint import Plain
from panolog.synthetic.shapes import box, ellipsoid
from panolog.synthetic.trace import PanoramaRays, PointRays, cast

PANORAMAS, WIDTH = 4, 128
GREY = Plain((0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("town"), panoramas=PANORAMAS, width=WIDTH, points=600)


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return read_scene(folder)


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_scene_reads_back(scene: Scene) -> None:
    rotations, centers = camera_path(PANORAMAS, 0)
    assert (scene.width, scene.height) == (WIDTH, WIDTH // 2)
    assert len(scene.points) == 600
    for index, panorama in enumerate(scene.panoramas):
        np.testing.assert_allclose(panorama.rotation, rotations[index], atol=1e-12)
        np.testing.assert_allclose(panorama.center, centers[index], atol=1e-9)
        assert panorama.depth is not None and panorama.sky_mask is not None
        assert panorama.mask is None and panorama.depth_affine is None
        assert len(panorama.observed) > 100
    assert set(scene.train) | set(scene.test) == set(range(PANORAMAS))


def test_every_point_is_seen_twice(folder: Path) -> None:
    model = read_panoramas(folder / "sparse" / "0")
    views = np.bincount(
        np.concatenate([image.observed for image in model.images]), minlength=len(model.points)
    )
    assert views.min() >= 2


def test_bytes_depend_on_arguments_alone(tmp_path: Path) -> None:
    first, other, again = (
        digest(make_town(tmp_path / str(number), panoramas=2, width=32, points=50, seed=seed))
        for number, seed in enumerate((0, 1, 0))
    )
    assert again == first
    assert other["images/street_000.png"] != first["images/street_000.png"]


def test_depth_and_mask_agree_with_the_points(scene: Scene) -> None:
    """Inverse distances of the points are an affine of the depth map, and points are not in the sky."""
    for panorama in scene.panoramas:
        depth = cv2.imread(str(panorama.depth), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(panorama.sky_mask), cv2.IMREAD_UNCHANGED)
        assert depth is not None and mask is not None
        assert depth.dtype == np.uint16 and depth.shape == (WIDTH // 4, WIDTH // 2)
        assert set(np.unique(mask)) == {0, 255} and mask.shape == (WIDTH // 2, WIDTH)
        camera = scene.points[panorama.observed] @ panorama.rotation.T + panorama.translation
        u, v = project(camera, WIDTH).T
        assert (mask[v.astype(int), u.astype(int)] == 255).mean() > 0.9
        mono = depth[(v / 2).astype(int), (u / 2).astype(int)] / 65535
        mono, inverse = mono[mono > 0], 1 / np.linalg.norm(camera, axis=1)[mono > 0]
        affine = np.polyfit(mono, inverse, 1)
        assert affine[0] > 0
        assert np.median(np.abs(np.polyval(affine, mono) - inverse) / inverse) < 0.15  # a pixel is 5.6° wide


@given(st.integers(0, 2**32), st.sampled_from([1, 3]))
def test_a_ray_goes_through_the_pixel_it_belongs_to(seed: int, samples: int) -> None:
    random = np.random.default_rng(seed)
    rotation = np.linalg.qr(random.standard_normal((3, 3)))[0]
    rays = PanoramaRays(rotation, np.zeros(3), 16, samples)
    pixels = project((rotation @ rays.directions).T, 16) * samples
    rows, columns = np.divmod(np.arange(rays.lines * rays.columns), rays.columns)
    np.testing.assert_allclose(pixels, np.stack([columns + 0.5, rows + 0.5], 1), atol=1e-2)


@given(st.integers(0, 2**32))
def test_windows_miss_nothing(seed: int) -> None:
    """A shape that is tried only on the rays near it is hit by the same rays as one tried on all: also across
    the seam, above, below and around the camera."""
    random = np.random.default_rng(seed)
    rotation = np.linalg.qr(random.standard_normal((3, 3)))[0]
    middle, size = random.normal(0, 3, 3), random.uniform(0.05, 2, 3)
    rays = PanoramaRays(rotation, np.zeros(3), 64, 1)
    for shape in (ellipsoid(middle, size, GREY), box(middle - size, middle + size, GREY)):
        everywhere = shape.enter(rays.origins, rays.directions)
        np.testing.assert_array_equal(cast([shape], rays).distance, everywhere)
        points = np.random.default_rng(seed).normal(0, 5, (50, 3))
        toward = PointRays(points, np.zeros(3))
        np.testing.assert_array_equal(
            cast([shape], toward).distance, shape.enter(toward.origins, toward.directions)
        )


def test_panoramas_between_others_are_held_out_and_no_part_of_the_cloud(tmp_path: Path) -> None:
    plain = read_scene(make_town(tmp_path / "plain", panoramas=3, width=64, points=100))
    scene = read_scene(make_town(tmp_path / "between", panoramas=3, width=64, points=100, between=True))
    assert (scene.train, scene.test) == ((0, 1, 2), (3, 4))
    np.testing.assert_array_equal(scene.centers[:3], plain.centers)
    np.testing.assert_allclose(scene.centers[3:], (plain.centers[1:] + plain.centers[:-1]) / 2, atol=1e-9)
    np.testing.assert_array_equal(scene.points, plain.points)


def test_progress_is_reported_in_order(tmp_path: Path) -> None:
    reported: list[tuple[int, int]] = []
    make_town(tmp_path, panoramas=2, width=32, points=50, progress=lambda *step: reported.append(step))
    assert reported == [(done, 4) for done in range(5)]
