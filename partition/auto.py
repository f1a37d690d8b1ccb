"""`--blocks auto`: the smallest grid whose blocks fit, split along the axes of the cameras."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import aabb
from panolog.partition.cells import Grid
from panolog.partition.contraction import contract

_FLAT = 0.2  # an axis along which cameras spread less than this part of the largest spread is not split
_MAX_CELLS = 16  # cells along one axis
_MAX_BLOCKS = 256  # cells
_MAX_POINTS = 20_000  # a sample of the points is enough for their density


@dataclass(frozen=True)
class Budget:
    """Upper limits of one block. Raises ValueError unless both are positive."""

    cameras: float  # inside the block
    share: float = 1.0  # of all points: an estimate of the share of Gaussians

    def __post_init__(self) -> None:
        if not (self.cameras > 0 and self.share > 0):
            raise ValueError(
                f"a block of {self.cameras:g} cameras and a share {self.share:g} of the points has no room"
            )


def choose_grid(
    centers: ArrayLike, points: ArrayLike, rho_tri: float, budget: Budget, least: int = 1
) -> Grid:
    """The grid of fewest blocks, at least `least`, each within the budget; of these the best balanced one.

    Cells are parts of the box, and only those in which cameras stand count. A grid with others, as of cameras
    in a ring, is taken only where no grid without them fits.
    If no grid fits, as when all points lie in one place, the best balanced one is taken.
    Axes along which the cameras hardly spread, such as the height in a street, are not split.

    Args: centers (K, 3) of the training cameras and points (N, 3), world units; rho_tri of eq. 7.
    Raises InputError as `aabb`, ValueError on values that are not finite.
    """
    cameras, cloud = np.asarray(centers, np.float64), np.asarray(points, np.float64)
    box = aabb(cameras, rho_tri)
    seen = contract(cloud[:: max(1, len(cloud) // _MAX_POINTS)], box)
    standing = contract(cameras, box)
    grids = [Grid(shape, "box" if max(shape) > 2 else "cube") for shape in _shapes(cameras)]
    busy = {grid: len(np.unique(grid.block_of(standing))) for grid in grids}
    least = min(least, max(busy.values()))
    loads = {grid: _load(grid, standing, seen, budget) for grid in grids if busy[grid] >= least}
    fitting = [grid for grid in loads if loads[grid] <= 1.0]
    if not fitting:
        return min(loads, key=lambda grid: (loads[grid], grid.count - busy[grid], grid.count, grid.shape))
    full = [grid for grid in fitting if busy[grid] == grid.count]
    return min(full or fitting, key=lambda grid: (busy[grid], grid.count, loads[grid], grid.shape))


def _shapes(centers: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    spread = np.ptp(centers, axis=0)
    longest = [_MAX_CELLS if axis >= _FLAT * spread.max() else 1 for axis in spread]
    shapes = product(*(range(1, most + 1) for most in longest))
    return [(x, y, z) for x, y, z in shapes if x * y * z <= _MAX_BLOCKS]


def _load(grid: Grid, cameras: NDArray[np.float64], points: NDArray[np.float64], budget: Budget) -> float:
    """The fullest block over the budget: above 1 it does not fit."""
    standing = np.bincount(grid.block_of(cameras)).max() / budget.cameras
    share = np.bincount(grid.block_of(points)).max(initial=0) / max(len(points), 1) / budget.share
    return float(max(standing, share))
