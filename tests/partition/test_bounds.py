import numpy as np
import pytest

from panolog.partition.bounds import Aabb, aabb, baseline, margin
from panolog.scene.errors import InputError

LINE = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [6, 0, 0]])  # nearest neighbours at 1, 1, 2, 3


def test_baseline_is_the_median_of_nearest_distances() -> None:
    assert baseline(LINE) == 1.5
    assert margin(LINE, 5.0) == 7.5


def test_baseline_does_not_depend_on_how_cameras_are_chunked() -> None:
    centers = np.random.default_rng(0).normal(size=(600, 3))
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.diag(np.full(600, np.inf))
    assert baseline(centers) == pytest.approx(np.median(distances.min(axis=1)), rel=1e-12)


def test_aabb_is_the_trajectory_about_its_centroid_plus_the_margin() -> None:
    box = aabb(LINE, 5.0)  # centroid 2.5, largest deviation 3.5
    np.testing.assert_allclose(box.lower, [2.5 - 3.5 - 7.5, -7.5, -7.5])
    np.testing.assert_allclose(box.upper, [2.5 + 3.5 + 7.5, 7.5, 7.5])


def test_flat_axes_without_a_margin_get_the_largest_extent() -> None:
    np.testing.assert_allclose(aabb(LINE, 0.0).half, [3.5, 3.5, 3.5])


def test_a_thin_axis_with_a_margin_is_left_as_the_paper_has_it() -> None:
    centers = np.stack([np.arange(1000.0), np.zeros(1000), np.zeros(1000)], axis=1)
    np.testing.assert_allclose(aabb(centers, 5.0).half, [504.5, 5.0, 5.0])


@pytest.mark.parametrize("place", [0.0, 1e3])
def test_cameras_at_one_position_are_refused(place: float) -> None:
    with pytest.raises(InputError, match="one position"):
        aabb(np.full((3, 3), place), 5.0)


def test_one_camera_is_refused() -> None:
    with pytest.raises(InputError, match="two cameras"):
        baseline(LINE[:1])


def test_a_camera_that_is_not_finite_is_named() -> None:
    with pytest.raises(ValueError, match="camera 2"):
        aabb(np.where(np.arange(4)[:, None] == 2, np.nan, LINE), 5.0)


@pytest.mark.parametrize(("lower", "upper"), [([0, 0, 0], [1, 0, 1]), ([0, 0, 0], [1, 1, np.inf])])
def test_a_box_needs_a_finite_volume(lower: list[float], upper: list[float]) -> None:
    with pytest.raises(ValueError, match="AABB"):
        Aabb(np.array(lower, float), np.array(upper, float))
