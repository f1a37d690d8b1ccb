from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from panolog.partition.auto import Budget, choose_grid
from panolog.partition.bounds import aabb
from panolog.partition.cells import Grid
from panolog.partition.contraction import contract

RANDOM = np.random.default_rng(0)
STREET = np.stack([np.linspace(0, 100, 64), np.zeros(64), 1.7 + 0.01 * RANDOM.normal(size=64)], axis=1)
FIELD = np.concatenate([RANDOM.uniform(0, 50, (256, 2)), 1.7 + 0.01 * RANDOM.normal(size=(256, 1))], axis=1)
CLOUD = RANDOM.uniform(-20, 120, (5000, 3))


def fullest(centers: NDArray[np.float64], grid: Grid) -> int:
    return int(np.bincount(grid.block_of(contract(centers, aabb(centers, 5.0)))).max())


def test_what_fits_one_block_is_one_block() -> None:
    assert choose_grid(STREET, CLOUD, 5.0, Budget(cameras=64)).shape == (1, 1, 1)


def test_a_street_is_cut_along_itself_only() -> None:
    grid = choose_grid(STREET, CLOUD, 5.0, Budget(cameras=20))
    assert grid.shape[1:] == (1, 1)
    assert grid.shape[0] > 1


def test_no_block_has_more_than_its_budget_and_no_smaller_grid_would_do() -> None:
    grid = choose_grid(FIELD, CLOUD, 5.0, Budget(cameras=80))
    assert grid.shape[2] == 1
    assert fullest(FIELD, grid) <= 80
    smaller = [Grid((x, y, 1), "box") for x in range(1, 9) for y in range(1, 9) if x * y < grid.count]
    assert all(fullest(FIELD, other) > 80 for other in smaller)


def test_of_grids_with_as_many_blocks_the_balanced_one_is_taken() -> None:
    grid = choose_grid(FIELD, np.zeros((0, 3)), 5.0, Budget(cameras=1e9), least=4)
    assert grid.shape == (2, 2, 1)


def test_dense_places_need_more_blocks() -> None:
    crowded = np.concatenate([CLOUD[:500], RANDOM.normal((90, 0, 0), size=(4500, 3))])
    spread = choose_grid(STREET, CLOUD, 5.0, Budget(cameras=64, share=0.6))
    dense = choose_grid(STREET, crowded, 5.0, Budget(cameras=64, share=0.6))
    assert dense.count > spread.count


def test_a_budget_that_nothing_meets_gives_the_best_there_is() -> None:
    assert choose_grid(STREET, CLOUD, 5.0, Budget(cameras=0.5)).shape[1:] == (1, 1)


def test_a_budget_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="has no room"):
        Budget(cameras=0)


def test_more_blocks_than_a_grid_can_have_are_as_many_as_it_can() -> None:
    grid = choose_grid(STREET, CLOUD, 5.0, Budget(cameras=64), least=1000)
    assert grid.shape[1:] == (1, 1) and 12 <= grid.count <= 16
    assert idle(STREET, grid) == 0


def idle(centers: NDArray[np.float64], grid: Grid, rho_tri: float = 5.0) -> int:
    """How many cells hold no camera."""
    return grid.count - len(np.unique(grid.block_of(contract(centers, aabb(centers, rho_tri)))))


def test_a_straight_street_is_cut_into_blocks_that_all_have_cameras() -> None:
    assert idle(STREET, Grid((8, 1, 1))) == 4  # equal parts of the cube, as in the paper
    grid = choose_grid(STREET, CLOUD, 5.0, Budget(cameras=64), least=4)
    assert (grid.shape, idle(STREET, grid)) == ((4, 1, 1), 0)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(40, 200),
    st.floats(0, 1),
    st.permutations(range(3)),
    st.floats(0.5, 8),
    st.integers(1, 8),
)
def test_no_cell_of_a_covered_place_is_idle(
    seed: int, count: int, width: float, axes: list[int], rho_tri: float, least: int
) -> None:
    """Cameras evenly along a street or all over a place of any aspect, whichever axes it lies in."""
    random = np.random.default_rng(seed)
    even = random.permuted(np.tile(np.linspace(-1, 1, count), (3, 1)), axis=1).T
    place = (even * (90, 90 * width, 0.5))[:, axes]
    grid = choose_grid(place, place, rho_tri, Budget(cameras=count), least=least)
    assert idle(place, grid, rho_tri) == 0
    assert grid.count >= least


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(1, 12), st.integers(1, 40))
def test_idle_cells_are_the_last_resort(seed: int, count: int, least: int, room: int) -> None:
    """Cameras in clusters anywhere."""
    random = np.random.default_rng(seed)
    centers = random.normal(size=(4, 3))[random.integers(0, 4, count)] + random.normal(0, 0.1, (count, 3))
    grid = choose_grid(centers, centers[:0], 5.0, Budget(cameras=room), least=least)
    if idle(centers, grid) and fullest(centers, grid) <= room:
        others = (Grid((x, y, z), "box") for x, y, z in product(range(1, 9), repeat=3) if x * y * z >= least)
        for other in others:
            assert idle(centers, other) or fullest(centers, other) > room


def test_a_ring_has_idle_cells_only_where_it_must() -> None:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.stack([100 * np.cos(angle), 100 * np.sin(angle), 0 * angle], axis=1)
    assert idle(ring, choose_grid(ring, CLOUD, 5.0, Budget(cameras=150))) == 0
    fine = choose_grid(ring, CLOUD, 5.0, Budget(cameras=20))
    assert fullest(ring, fine) <= 20
    assert idle(ring, fine) > 0
