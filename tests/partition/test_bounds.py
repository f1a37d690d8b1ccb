import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from panolog.partition.bounds import Aabb, aabb, baseline, strays
from panolog.partition.cells import Grid
from panolog.partition.contraction import contract
from panolog.scene.errors import InputError

LINE = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [6, 0, 0]])  # nearest neighbours at 1, 1, 2, 3


def test_baseline_is_that_of_all_pairs() -> None:
    centers = np.random.default_rng(0).normal(size=(600, 3))
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.diag(np.full(600, np.inf))
    assert baseline(centers) == pytest.approx(np.median(distances.min(axis=1)), rel=1e-12)


@pytest.mark.parametrize("play", [0.0, 0.004])
def test_spots_of_a_tripod_count_once(play: float) -> None:
    """Three pictures at each of forty spots, and a few spots with one."""
    random = np.random.default_rng(2)
    spots = np.arange(46.0)[:, None] * (1.5, 0.2, 0.0) + random.normal(0, 0.1, (46, 3))
    centers = np.concatenate([np.repeat(spots[:40], 3, axis=0), spots[40:]])
    centers += random.normal(0, play, centers.shape)
    assert baseline(centers) == pytest.approx(baseline(spots), rel=0.02)
    assert baseline(np.full((40, 3), 2.0)) == 0


def test_groups_of_a_walk_are_no_spots() -> None:
    """Eq. 8 to the letter, however far the groups of cameras that lie in line are apart."""
    line = np.arange(12.0)[:, None] * (1.0, 0, 0)
    groups = np.concatenate([line + np.array([0, 1000.0 * group, 0]) for group in range(5)])
    assert baseline(groups) == 1
    assert baseline(np.concatenate([line, line + np.array([0, 0.1, 0])])) == pytest.approx(
        0.1
    )  # two ways side by side


def test_a_stray_camera_widens_nothing() -> None:
    walk = np.random.default_rng(1).normal(0, (20, 10, 0.1), (16, 3))
    box = aabb(walk, 5.0)
    lost = np.insert(walk, 3, (8000.0, 50.0, -3000.0), axis=0)
    assert np.flatnonzero(strays(lost)).tolist() == [3]
    np.testing.assert_allclose(aabb(lost, 5.0).half, box.half, rtol=0.1)
    assert not strays(walk).any()
    assert not strays(np.concatenate([walk, walk + np.array([1e5, 0, 0])])).any()  # two sites
    assert not strays(np.array([[0.0, 0, 0], [1, 0, 0], [1e4, 0, 0]])).any()  # which of three?


def test_aabb_is_the_trajectory_about_its_centroid_plus_the_margin() -> None:
    box = aabb(LINE, 5.0)  # centroid 2.5, largest deviation 3.5
    np.testing.assert_allclose(box.lower, [2.5 - 3.5 - 7.5, -7.5, -7.5])
    np.testing.assert_allclose(box.upper, [2.5 + 3.5 + 7.5, 7.5, 7.5])


def test_no_axis_is_shorter_than_its_share_of_the_longest() -> None:
    np.testing.assert_allclose(aabb(LINE, 0.0, aspect=0.5).half, [3.5, 1.75, 1.75])
    np.testing.assert_allclose(aabb(LINE, 0.0).half, [3.5, 3.5e-6, 3.5e-6])
    centers = np.stack([np.zeros(1000), np.arange(1000.0), np.linspace(0, 800, 1000)], axis=1)
    rho = 5.0 / baseline(centers)
    np.testing.assert_allclose(aabb(centers, rho, aspect=0.5).half, [252.25, 504.5, 405.0])
    np.testing.assert_allclose(aabb(centers, rho).half, [5.0, 504.5, 405.0])


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.permutations(range(3)),
    st.tuples(*[st.integers(1, 7)] * 3),
    st.floats(0, 10),
    st.floats(0.05, 1),
)
def test_a_vertical_line_in_the_footprint_stays_in_one_column(
    seed: int, axes: list[int], shape: tuple[int, int, int], rho_tri: float, narrow: float
) -> None:
    """Level walks, any axis vertical; lines reach up and down half the footprint's half width."""
    random = np.random.default_rng(seed)
    walk = random.uniform(-100, 100, (40, 3)) * (1, narrow, 0.002)
    box = aabb(walk[:, axes], rho_tri, aspect=0.5)
    footprint, up = [axes.index(0), axes.index(1)], axes.index(2)
    height = box.half[footprint].max() / 2
    feet = box.center + random.uniform(-1, 1, (20, 3)) * box.half
    lines = np.repeat(feet[:, None], 30, axis=1)
    lines[:, :, up] = box.center[up] + np.linspace(-height, height, 32)[1:-1]
    cells = np.unravel_index(Grid(shape).block_of(contract(lines.reshape(-1, 3), box)), shape, order="F")
    for axis in footprint:
        columns = cells[axis].reshape(lines.shape[:2])
        assert (columns == columns[:, :1]).all()


@pytest.mark.parametrize(
    ("centers", "words"),
    [
        (np.full((3, 3), 0.0), "one position"),
        (np.full((3, 3), 1e3), "one position"),
        (LINE[:1], "two cameras"),
        (np.where(np.arange(4)[:, None] == 2, np.nan, LINE), "camera 2"),
    ],
)
def test_cameras_without_a_volume_are_refused(centers: NDArray[np.float64], words: str) -> None:
    with pytest.raises(ValueError if "camera 2" in words else InputError, match=words):
        aabb(centers, 5.0)


@pytest.mark.parametrize(("lower", "upper"), [([0, 0, 0], [1, 0, 1]), ([0, 0, 0], [1, 1, np.inf])])
def test_a_box_needs_a_finite_volume(lower: list[float], upper: list[float]) -> None:
    with pytest.raises(ValueError, match="AABB"):
        Aabb(np.array(lower, float), np.array(upper, float))
