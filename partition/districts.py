"""Districts: parts of a place whose Stage I is trained apart, and which cameras each of them has."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.balance import balance
from panolog.partition.bounds import Aabb, margin
from panolog.partition.cells import Cell, Cuts


@dataclass(frozen=True, eq=False)
class Districts:
    """Half-open cells of contracted space, balanced, with cameras that overlap.

    A district is trained on the cameras in its cell and on those nearer to it than a margin, and what it has
    in its cell is kept. Within the box cells are boxes of the world; the outermost have no end.
    """

    cuts: Cuts
    box: Aabb
    margin: float  # world units
    centers: NDArray[np.float64]  # (K, 3) of the training cameras

    @property
    def count(self) -> int:
        """How many there are."""
        return self.cuts.count

    def cell(self, district: int) -> Cell:
        """The part of space of which a district keeps its Gaussians."""
        return Cell(self.box, self.cuts, district)

    @cached_property
    def cameras(self) -> NDArray[np.bool_]:
        """(D, K) which cameras train which districts; each trains at least that which it stands in."""
        bounds = [self.cuts.bounds(district) for district in range(self.count)]
        return np.stack([self._near(lower, upper) for lower, upper in bounds])

    def _near(self, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.bool_]:
        low, high = (self.box.center + self.box.half * (4 * bound - 2) for bound in (lower, upper))
        low = np.where(lower <= 0.25, -np.inf, low - self.margin)
        high = np.where(upper >= 0.75, np.inf, high + self.margin)
        return np.asarray(((self.centers >= low) & (self.centers < high)).all(axis=1))


def make_districts(
    centers: ArrayLike,
    points: ArrayLike,
    box: Aabb,
    count: int,
    fewest: int = 1,
    *,
    overlap: float,
) -> Districts:
    """Makes `count` districts, or as many as there are cameras for; other arguments and errors as `balance`.

    Args: overlap, their margin in median camera distances.
    """
    cameras = np.asarray(centers, np.float64)
    return Districts(balance(cameras, points, box, count, fewest), box, margin(cameras, overlap), cameras)
