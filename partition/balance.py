"""Balanced cells: half-open cuts after which all blocks have about as much to do (`--blocks 8`, `auto`)."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import MOST_BLOCKS, Axis, Cut, Cuts
from panolog.partition.contraction import contract

_FLAT = 0.2  # an axis along which cameras spread less than this part of the largest spread is not cut
_MOST_POINTS = 100_000  # a sample of the points is enough for their density


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


@dataclass(frozen=True, eq=False)
class _Part:
    """Cameras and points that are not cut yet, contracted; each half of the cost."""

    cameras: NDArray[np.float64]  # (K, 3)
    points: NDArray[np.float64]  # (N, 3)
    weights: tuple[float, float]  # of one camera, of one point

    def cut(self, axis: int, at: float) -> "tuple[_Part, _Part]":
        """What is below, and what is on the cut or above."""
        below = [array[:, axis] < at for array in (self.cameras, self.points)]
        sides = [(self.cameras[a], self.points[b]) for a, b in (below, [~rows for rows in below])]
        return _Part(*sides[0], self.weights), _Part(*sides[1], self.weights)

    def quantile(self, axis: int, share: float) -> float:
        """The coordinate below which this share of the cost lies."""
        values = np.concatenate([self.cameras[:, axis], self.points[:, axis]])
        weights = np.repeat(self.weights, [len(self.cameras), len(self.points)])
        order = np.argsort(values, kind="stable")
        summed = np.cumsum(weights[order])
        i = int(np.searchsorted(summed, share * summed[-1]))
        return float(values[order[max(i - 1, 0) : i + 1]].mean())


def balance(centers: ArrayLike, points: ArrayLike, box: Aabb, blocks: int, fewest: int = 1) -> Cuts:
    """Cuts into `blocks`, or as many as can be, of which each costs about the same and has `fewest` cameras.

    What a block costs is expected to follow its share of the cameras and its share of the sparse points, half
    each. A part is cut across the axis along which its cameras spread most; the axis of least spread, such as
    the height above a street, is never cut, so that from above each block is seen.

    Args: centers (K, 3) of the training cameras and points (N, 3), world units; box, the cameras' AABB.
    Raises ValueError on values that are not finite.
    """
    cameras, cloud = np.asarray(centers, np.float64), np.asarray(points, np.float64)
    cloud = contract(cloud[:: -(-len(cloud) // _MOST_POINTS) or 1], box)
    spread = np.ptp(cameras, axis=0)
    axes = [axis for axis in np.argsort(-spread, kind="stable")[:2] if spread[axis] >= _FLAT * spread.max()]
    weights = 1 / len(cameras), 1 / max(len(cloud), 1)
    whole = _Part(contract(cameras, box), cloud, weights)
    scale = 2 * box.half  # contracted lengths inside the box are proportional to this
    return Cuts(tuple(_cuts(whole, min(blocks, MOST_BLOCKS), fewest, sorted(axes), scale)))


def fewest_blocks(
    centers: ArrayLike,
    points: ArrayLike,
    box: Aabb,
    budget: Budget,
    *,
    least: int = 1,
    fewest: int = 1,
) -> int:
    """How few balanced blocks, at least `least`, are each within the budget; other arguments as `balance`.

    If none are, as when all points lie in one place, that number whose fullest block is least above it.
    """
    cameras, cloud = np.asarray(centers, np.float64), np.asarray(points, np.float64)
    standing, seen = contract(cameras, box), contract(cloud, box)
    first = max(least, int(np.ceil(len(cameras) / budget.cameras)), int(np.ceil(1 / budget.share)))
    first = min(first, MOST_BLOCKS)
    best, lowest = 1, np.inf
    for blocks in range(first, min(2 * first + 16, MOST_BLOCKS + 1)):
        cuts = balance(cameras, cloud, box, blocks, fewest)
        share = np.bincount(cuts.block_of(seen)).max(initial=0) / max(len(cloud), 1)
        load = max(np.bincount(cuts.block_of(standing)).max() / budget.cameras, share / budget.share)
        if load < lowest:
            best, lowest = cuts.count, load
        if load <= 1.0 or cuts.count < blocks:
            break
    return best


def _cuts(
    part: _Part, blocks: int, fewest: int, axes: list[int], scale: NDArray[np.float64]
) -> Iterator[Cut]:
    """The cuts of a part in preorder."""
    wide = sorted(axes, key=lambda axis: -float(np.ptp(part.cameras[:, axis]) * scale[axis]))
    for count, axis in product(range(min(blocks, len(part.cameras) // fewest), 1, -1), wide):
        at = _place(part, axis, count, fewest)
        if at is not None:
            below, above = part.cut(axis, at)
            lower = list(_cuts(below, count // 2, fewest, axes, scale))
            yield cast(Axis, "xyz"[axis]), at, len(lower) + 1
            yield from lower
            yield from _cuts(above, count - count // 2, fewest, axes, scale)
            return


def _place(part: _Part, axis: int, blocks: int, fewest: int) -> float | None:
    """Where to cut so that half of the blocks, rounded down, lie below; None if some would lack cameras."""
    cameras = np.sort(part.cameras[:, axis])
    gaps = np.flatnonzero(np.diff(cameras) > 0) + 1  # numbers of cameras below
    gaps = gaps[(gaps >= blocks // 2 * fewest) & (len(cameras) - gaps >= (blocks - blocks // 2) * fewest)]
    if not len(gaps):
        return None
    wanted = part.quantile(axis, blocks // 2 / blocks)
    first, last = (float(cameras[gap - 1 : gap + 1].mean()) for gap in gaps[[0, -1]])
    return min(max(wanted, first), last)
