import numpy as np
import pytest
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
    smaller = [Grid((x, y, 1)) for x in range(1, 9) for y in range(1, 9) if x * y < grid.count]
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
    assert choose_grid(STREET, CLOUD, 5.0, Budget(cameras=64), least=1000).shape == (16, 1, 1)
