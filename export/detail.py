"""A model cut into leaves of a k-d tree, each with levels of detail: what streamed formats are made of.

A viewer loads the leaves that are near. Their rows are sorted on the disk, so that memory holds the positions
of all Gaussians and the rest of one leaf. Level 0 has all of a leaf. On level k what is smaller than cubes of
side s·2^(k−1) is merged (`partition.levels`): the same sides in all leaves, so that a viewer may show
neighbours on the same level without a step.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.export.order import means_of, morton_order
from panolog.export.splats import REST, Splats, SplatSource
from panolog.partition.array_file import sorted_runs
from panolog.partition.levels import Levels, make_levels

Corners = tuple[NDArray[np.float64], NDArray[np.float64]]  # lower and upper of a box, (3,) each
MOST = 512 * 1024  # Gaussians of a leaf
SIDE = 16.0  # metres of a leaf, at most
_LEAST = 4096  # Gaussians, of which at least a leaf has that is cut because it is large
_CUBES = 0.1  # of the Gaussians that there are cubes of level 1; it has about 0.4 of them, as large ones stay
_FEWER = 0.33  # of the Gaussians of a level that the next one has, about
_SAMPLE = 2**18  # neighbouring Gaussians, at most, by which the side of these cubes is chosen
_FIRST = 150_000  # Gaussians of the coarsest level, about: what a viewer loads first
_MOST_LEVELS = 8
_LOW_PASS = 0.33  # standard deviation of a renderer's filter, in sides of a cube that spans two pixels


@dataclass(frozen=True, eq=False)
class Node:
    """A node of the tree: two children, or a leaf."""

    lower: NDArray[np.float32]  # (3,) of the means in it
    upper: NDArray[np.float32]  # (3,)
    count: int  # Gaussians in it
    children: "tuple[Node, Node] | None"
    leaf: int | None  # its number, in the order of the tree


class Detail:
    """The leaves of a model and their levels of detail."""

    def __init__(
        self,
        source: SplatSource,
        scratch: Path,
        *,
        side: float = SIDE,
        most: int = MOST,
        levels: int | None = None,
    ) -> None:
        """Cuts a model into leaves.

        Args: source, at least one Gaussian; scratch, a folder on a disk with room for 236 bytes of each; side
        of a leaf at most, in units of the model, unless it has few Gaussians; most Gaussians of a leaf;
        levels, how many with the whole one, None = until the coarsest has about 150,000.
        """
        self._source, self._scratch = source, scratch
        means = means_of(source)
        rows = np.arange(len(means), dtype=np.int32)
        self._labels = np.empty(len(means), np.int32)
        self._count = 0  # leaves
        self.tree = self._cut(means, rows, side, most)
        self._cube = _merging_side(means)
        self.sides = self._sides(means, levels)

    def leaves(self) -> Iterator[tuple[Splats, ...]]:
        """What each leaf shows on each level, in the order of their numbers, each in Morton order.

        The first level has all of its Gaussians. Raises OSError if the scratch disk is full.
        """
        pieces = (piece.columns() for piece in self._source.pieces())
        labels = self._labels.astype(np.int64)
        for columns in sorted_runs(self._scratch, pieces, labels, self._count):
            own = Splats(**columns)
            yield tuple(self._levels(own.select(morton_order(own.means))))

    def _cut(self, means: NDArray[np.float32], rows: NDArray[np.int32], side: float, most: int) -> Node:
        """The node of some rows, cut in the middle of its longest axis: of the rows if there are too many."""
        own = means[rows]
        lower, upper = own.min(axis=0), own.max(axis=0)
        axis = int((upper - lower).argmax())
        middle = len(rows) // 2
        if len(rows) > most:
            order = np.argpartition(own[:, axis], middle)
            parts = rows[np.sort(order[:middle])], rows[np.sort(order[middle:])]
        else:
            left = own[:, axis] < (lower[axis] + upper[axis]) / 2
            parts = rows[left], rows[~left]
        large = len(rows) > _LEAST and float(upper[axis] - lower[axis]) > side
        if len(rows) <= most and not (large and all(map(len, parts))):
            self._labels[rows] = number = self._count
            self._count += 1
            return Node(lower, upper, len(rows), None, number)
        del own
        children = (self._cut(means, parts[0], side, most), self._cut(means, parts[1], side, most))
        return Node(lower, upper, len(rows), children, None)

    def _sides(self, means: NDArray[np.float32], levels: int | None) -> tuple[float, ...]:
        """The side of the cubes of each level, world units; 0 of the whole one."""
        if levels is not None:
            return (0.0, *(self._cube * 2.0**k for k in range(levels - 1)))
        sides, count = [0.0], float(len(means))
        while count > _FIRST and len(sides) < _MOST_LEVELS:
            sides.append(self._cube * 2.0 ** (len(sides) - 1))
            count *= _FEWER
        return tuple(sides)

    def _levels(self, own: Splats) -> Iterator[Splats]:
        yield own
        if len(self.sides) == 1:
            return
        made = make_levels(own.gaussians(), self._cube, _LOW_PASS, len(self.sides) - 1)
        for k in range(1, len(self.sides)):
            level = made.levels[min(k, len(made.levels) - 1)]
            yield _splats(made, np.arange(level.starts[0], level.starts[-1]), own.degree)


def around(boxes: Sequence[Corners]) -> Corners:
    """The box that holds some boxes, at least one."""
    lower, upper = zip(*boxes, strict=True)
    return np.min(lower, axis=0), np.max(upper, axis=0)


def _merging_side(means: NDArray[np.float32]) -> float:
    """The side of cubes of which the Gaussians occupy `_CUBES` times as many as they are.

    By a part of the model around its median, where it is as dense as elsewhere.
    """
    apart = np.abs(means - np.median(means[:: max(1, len(means) // _SAMPLE)], axis=0)).max(axis=1)
    near = means[np.argpartition(apart, _SAMPLE)[:_SAMPLE]] if len(means) > _SAMPLE else means
    low, high = 0.0, float(np.ptp(near, axis=0).max()) or 1.0
    places = near - near.min(axis=0)
    for _ in range(24):
        side = (low + high) / 2
        cubes = np.floor(places / side).astype(np.int64)
        keys = cubes[:, 0] << 42 | cubes[:, 1] << 21 | cubes[:, 2]
        few = len(np.unique(keys)) < _CUBES * len(near)
        low, high = (low, side) if few else (side, high)
    return high


def _splats(levels: Levels, rows: NDArray[np.int64], degree: int) -> Splats:
    found = {name: tensor.numpy() for name, tensor in levels.rows(rows).tensors().items()}
    return Splats(**found | {"sh0": found["sh0"][:, 0], "shN": found["shN"][:, : REST[degree]]})
