"""The contracted cube as cells, half-open, without gap or overlap: a grid, or a k-d tree of cuts."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.contraction import contract

Layout = Literal["cube", "box"]  # what the cells along an axis are equal parts of
Axis = Literal["x", "y", "z"]
Cut = tuple[Axis, float, int]  # axis, contracted coordinate, number of blocks below it
MOST_BLOCKS = 16_384  # every camera has a score for each: 13 GB for 100,000 cameras


class Volume(Protocol):
    """A part of space, such as `Cell`."""

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """(N,) which world points (N, 3) are in it. Raises ValueError if a coordinate is not finite."""


class Face(NamedTuple):
    """Where cells meet: the plane on which one contracted coordinate is `at`, between two corners."""

    axis: int
    at: float
    lower: NDArray[np.float64]  # (3,)
    upper: NDArray[np.float64]  # (3,)


@dataclass(frozen=True)
class Grid:
    """A grid over the contracted cube; block id = (z·B_y + y)·B_x + x.

    Cells are equal parts of the cube, as in the paper, or of the AABB in its middle half: the outermost cells
    then reach from there to the faces of the cube. With one or two cells along each axis both are the same.

    Raises ValueError unless `shape` is three integers of at least 1.
    """

    shape: tuple[int, int, int]  # (B_x, B_y, B_z)
    layout: Layout = "cube"

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or any(not isinstance(n, int) or n < 1 for n in self.shape):
            raise ValueError(f"a block grid needs three numbers of at least 1, such as 2x1x1, not {self}")

    def __str__(self) -> str:
        return "x".join(map(str, self.shape))

    @staticmethod
    def parse(text: str, layout: Layout = "cube") -> "Grid":
        """From the form "2x1x1". Raises ValueError on anything else."""
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})x(\d{1,5})", text.strip().lower(), re.ASCII)
        if match is None:
            raise ValueError(f"a block grid is written like 2x1x1, not {text!r}")
        x, y, z = map(int, match.groups())
        if x * y * z > MOST_BLOCKS:
            raise ValueError(
                f"{x * y * z} blocks are too many: {text} must be at most {MOST_BLOCKS}, such as 2x1x1"
            )
        return Grid((x, y, z), layout)

    @property
    def count(self) -> int:
        """The number of blocks."""
        x, y, z = self.shape
        return x * y * z

    @cached_property
    def edges(self) -> tuple[NDArray[np.float64], ...]:
        """For each axis the (B + 1,) faces of its cells, 0 and 1 included: the source of all cell limits."""
        uniform = tuple(np.arange(n + 1) / n for n in self.shape)
        if self.layout == "box":
            for edges in uniform:
                edges[1:-1] = 0.25 + 0.5 * edges[1:-1]
        return uniform

    @property
    def faces(self) -> Sequence[Face]:
        """What separates the cells: whole planes."""
        planes = [(axis, at) for axis, edges in enumerate(self.edges) for at in edges[1:-1].tolist()]
        return [Face(axis, at, np.zeros(3), np.ones(3)) for axis, at in planes]

    def block_of(self, contracted: ArrayLike) -> NDArray[np.int64]:
        """The one block of every point: on an inner face the upper one, on the cube's faces the outermost.

        Args: contracted (N, 3) in [0, 1]. Returns (N,) block ids.
        Raises ValueError if a coordinate is not finite or outside the cube.
        """
        y = _checked(contracted)
        cell = [np.searchsorted(edges[1:-1], y[:, d], side="right") for d, edges in enumerate(self.edges)]
        return np.ravel_multi_index(cell, self.shape, order="F")

    def bounds(self, block: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3,) lower and upper corner of the half-open cell [l_b, u_b) in contracted coordinates (eq. 12).

        Raises ValueError if there is no such block.
        """
        if not 0 <= block < self.count:
            raise ValueError(f"the grid {self} has blocks 0 to {self.count - 1}, not {block}")
        cell = np.unravel_index(block, self.shape, order="F")
        lower = np.array([edges[i] for edges, i in zip(self.edges, cell, strict=True)])
        upper = np.array([edges[i + 1] for edges, i in zip(self.edges, cell, strict=True)])
        return lower, upper


@dataclass(frozen=True)
class Cuts:
    """A k-d tree over the contracted cube: cuts along the axes, whose leaves are the blocks from 0 on.

    The cuts are in preorder: each is followed by those of the part below it, then by those above.

    Raises ValueError if a cut is not inside of the part that it cuts, or leaves a side without a block.
    """

    cuts: tuple[Cut, ...]

    def __post_init__(self) -> None:
        if self.count > MOST_BLOCKS:
            raise ValueError(f"{self.count} blocks are too many: at most {MOST_BLOCKS} are possible")
        self._tree  # noqa: B018  # raises

    def __str__(self) -> str:
        return "balanced"

    @property
    def count(self) -> int:
        """The number of blocks."""
        return len(self.cuts) + 1

    @cached_property
    def _tree(self) -> "_Tree":
        lower, upper = np.zeros((self.count, 3)), np.ones((self.count, 3))
        children, faces = np.empty((len(self.cuts), 2), np.int64), list[Face]()
        parts = [(0, self.count)]  # first block and number of blocks, of those that are not cut yet
        while parts:
            first, count = parts.pop()
            if count == 1:
                continue
            node = len(faces)
            name, at, below = self.cuts[node]
            axis, above = "xyz".index(name), first + below
            if not (0 < below < count and lower[first, axis] < at < upper[first, axis]):
                raise ValueError(
                    f"the cut {name} = {at:g} with {below} of {count} blocks below has an empty side"
                )
            faces.append(Face(axis, at, lower[first].copy(), upper[first].copy()))
            upper[first:above, axis] = lower[above : first + count, axis] = at
            children[node] = node + 1 if below > 1 else ~first, node + below if count - below > 1 else ~above
            parts += [(above, count - below), (first, below)]
        return _Tree(lower, upper, children, faces)

    @property
    def faces(self) -> Sequence[Face]:
        """What separates the cells, one for each cut."""
        return self._tree.faces

    def block_of(self, contracted: ArrayLike) -> NDArray[np.int64]:
        """The one block of every point; arguments and errors as `Grid.block_of`."""
        y, tree = _checked(contracted), self._tree
        axes = np.array([face.axis for face in tree.faces], np.int64)
        at = np.array([face.at for face in tree.faces])
        node = np.full(len(y), 0 if self.cuts else ~0)
        while len(rows := np.flatnonzero(node >= 0)):
            here = node[rows]
            above = y[rows, axes[here]] >= at[here]
            node[rows] = tree.children[here, above.astype(np.int64)]
        return ~node

    def bounds(self, block: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3,) lower and upper corner of the half-open cell [l_b, u_b) in contracted coordinates (eq. 12).

        Raises ValueError if there is no such block.
        """
        if not 0 <= block < self.count:
            raise ValueError(f"the {self.count} blocks are 0 to {self.count - 1}, not {block}")
        return self._tree.lower[block], self._tree.upper[block]


class _Tree(NamedTuple):
    """What follows from cuts."""

    lower: NDArray[np.float64]  # (B, 3) of the cells
    upper: NDArray[np.float64]  # (B, 3)
    children: NDArray[np.int64]  # (B - 1, 2) below and above each cut: another cut, or ~block
    faces: list[Face]


Cells = Grid | Cuts


def _checked(contracted: ArrayLike) -> NDArray[np.float64]:
    y = np.asarray(contracted, np.float64)
    if y.ndim != 2 or y.shape[1] != 3:
        raise ValueError(f"contracted points need the shape (N, 3), not {y.shape}")
    if not ((y >= 0.0) & (y <= 1.0)).all():  # false for NaN too
        raise ValueError("contracted points must lie in the unit cube")
    return y


@dataclass(frozen=True, eq=False)
class Cell:
    """One block's share of all space. Raises ValueError if there is no such block."""

    aabb: Aabb
    grid: Cells
    block: int

    def __post_init__(self) -> None:
        self.grid.bounds(self.block)

    def __str__(self) -> str:
        return f"block {self.block}"

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which world points (N, 3) belong to this block, (N,). Every finite point belongs to exactly one.

        Raises ValueError if a coordinate is not finite.
        """
        inside: NDArray[np.bool_] = self.grid.block_of(contract(points, self.aabb)) == self.block
        return inside
