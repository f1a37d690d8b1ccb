"""Blocks and districts that cost about the same, cut where cameras can be separated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from panolog.partition.balance import Budget, balance, fewest_blocks
from panolog.partition.bounds import Aabb, aabb, margin
from panolog.partition.cells import Cells, Cuts, Grid
from panolog.partition.contraction import contract
from panolog.partition.districts import make_districts

RANDOM = np.random.default_rng(0)
STREET = np.stack([np.linspace(0, 100, 64), np.zeros(64), 1.7 + 0.01 * RANDOM.normal(size=64)], axis=1)
FIELD = np.concatenate([RANDOM.uniform(0, 50, (256, 2)), 1.7 + 0.01 * RANDOM.normal(size=(256, 1))], axis=1)
WIDE = np.concatenate([RANDOM.uniform(0, 200, (400, 2)), RANDOM.normal(2, 0.1, (400, 1))], axis=1)
CLOUD = RANDOM.uniform(-20, 120, (5000, 3))
CORNER = 200 * RANDOM.random((400, 1)) ** 3 * [1, 0, 0] + 60 * RANDOM.random((400, 1)) ** 2 * [0, 1, 0]


def box_of(centers: NDArray[np.float64], rho_tri: float = 5.0) -> Aabb:
    return aabb(centers, rho_tri, aspect=0.5)


def inside(places: NDArray[np.float64], cells: Cells, centers: NDArray[np.float64]) -> NDArray[np.int64]:
    """How many of the places are in each block."""
    return np.bincount(cells.block_of(contract(places, box_of(centers))), minlength=cells.count)


def imbalance(centers: NDArray[np.float64], points: NDArray[np.float64], cells: Cells) -> float:
    """The most expensive block over the mean."""
    costs = inside(centers, cells, centers) / len(centers) + inside(points, cells, centers) / len(points)
    return float(costs.max() / costs.mean())


def test_a_street_is_cut_along_itself_only() -> None:
    cuts = balance(STREET, CLOUD, box_of(STREET), 5)
    assert [(axis, below) for axis, _, below in cuts.cuts] == [("x", 2), ("x", 1), ("x", 1), ("x", 1)]


def test_a_field_is_cut_along_both_axes_but_not_in_height() -> None:
    axes = {axis for axis, _, _ in balance(FIELD, FIELD, box_of(FIELD), 16).cuts}
    assert axes == {"x", "y"}


@pytest.mark.parametrize("blocks", [2, 3, 8, 13, 32])
def test_balanced_blocks_cost_the_same_where_equal_parts_do_not(blocks: int) -> None:
    points = np.tile(CORNER, (10, 1)) + RANDOM.normal(0, 8, (4000, 3))
    cuts = balance(CORNER, points, box_of(CORNER), blocks)
    assert cuts.count == blocks
    assert imbalance(CORNER, points, cuts) < 1.15
    uniform = Grid((4, 2, 1), "box")
    assert imbalance(CORNER, points, uniform) > 2


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 60), st.integers(1, 20), st.integers(1, 4))
def test_every_block_has_cameras_enough(seed: int, count: int, blocks: int, fewest: int) -> None:
    """Cameras in clusters anywhere, some at the same place."""
    random = np.random.default_rng(seed)
    centers = random.normal(size=(4, 3))[random.integers(0, 4, count)]
    centers += np.round(random.normal(0, 0.1, (count, 3)), 1)
    cuts = balance(centers, centers[:0], box_of(centers), blocks, fewest)
    assert cuts.count <= blocks
    assert inside(centers, cuts, centers).min() >= min(fewest, count)


def test_cameras_that_cannot_be_separated_are_one_block() -> None:
    centers = np.repeat([[0.0, 0, 0], [9.0, 1, 0]], (7, 1), axis=0)
    assert balance(centers, CLOUD, box_of(centers), 4).count == 2
    assert balance(centers, CLOUD, box_of(centers), 4, fewest=2) == Cuts(())


def test_no_block_has_more_than_its_budget() -> None:
    assert fewest_blocks(STREET, CLOUD, box_of(STREET), Budget(cameras=64)) == 1
    assert fewest_blocks(FIELD, CLOUD, box_of(FIELD), Budget(cameras=1e9), least=6) == 6
    blocks = fewest_blocks(FIELD, CLOUD, box_of(FIELD), Budget(cameras=80, share=0.5))
    assert inside(FIELD, balance(FIELD, CLOUD, box_of(FIELD), blocks), FIELD).max() <= 80
    fewer = balance(FIELD, CLOUD, box_of(FIELD), blocks - 1)
    assert inside(FIELD, fewer, FIELD).max() > 80 or inside(CLOUD, fewer, FIELD).max() > len(CLOUD) / 2


def test_dense_places_need_more_blocks() -> None:
    crowded = np.concatenate([CLOUD[:500], RANDOM.normal((90, 0, 0), size=(4500, 3))])
    spread = fewest_blocks(STREET, CLOUD, box_of(STREET), Budget(cameras=64, share=0.4))
    dense = fewest_blocks(STREET, crowded, box_of(STREET), Budget(cameras=64, share=0.4))
    assert dense > spread


def test_a_budget_that_nothing_meets_gives_the_best_there_is() -> None:
    place = np.zeros((100, 3))
    assert 1 <= fewest_blocks(STREET, place, box_of(STREET), Budget(cameras=64, share=0.1)) <= 64
    assert fewest_blocks(STREET, CLOUD, box_of(STREET), Budget(cameras=0.5), fewest=3) == 21


def test_a_budget_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="has no room"):
        Budget(cameras=0)


@pytest.mark.parametrize("count", [1, 2, 4, 9])
def test_a_camera_trains_the_districts_within_the_margin(count: int) -> None:
    districts = make_districts(WIDE, WIDE, box_of(WIDE, 2.0), count, overlap=2.0)
    assert districts.count == count
    own = np.stack([districts.cell(district).contains(WIDE) for district in range(count)])
    assert (own.sum(axis=0) == 1).all()
    away = np.array([[np.linalg.norm(WIDE[mine] - center, axis=1).min() for center in WIDE] for mine in own])
    near = margin(WIDE, 2.0)
    assert away[districts.cameras].max() < 6 * near  # a district's cameras do not reach its very edge
    assert districts.cameras[away < near / 2].all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(1, 12), st.floats(0, 8))
def test_every_camera_trains_the_district_that_it_stands_in(
    seed: int, cameras: int, count: int, rho_tri: float
) -> None:
    random = np.random.default_rng(seed)
    centers = random.normal(size=(4, 3))[random.integers(0, 4, cameras)] + random.normal(0, 0.1, (cameras, 3))
    districts = make_districts(centers, centers[:0], box_of(centers, rho_tri), count, overlap=rho_tri)
    own = np.stack([districts.cell(district).contains(centers) for district in range(districts.count)])
    assert not (own & ~districts.cameras).any()
