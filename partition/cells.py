"""The contracted cube as a grid of blocks: half-open cells without gap or overlap."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.contraction import contract

Layout = Literal["cube", "box"]  # what the cells along an axis are equal parts of
_MOST_BLOCKS = 4096  # every camera has a score for each; far more than a city needs


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
        match = re.fullmatch(r"(\d{1,4})x(\d{1,4})x(\d{1,4})", text.strip().lower(), re.ASCII)
        if match is None:
            raise ValueError(f"a block grid is written like 2x1x1, not {text!r}")
        x, y, z = map(int, match.groups())
        if x * y * z > _MOST_BLOCKS:
            raise ValueError(
                f"{x * y * z} blocks are too many: {text} must be at most {_MOST_BLOCKS}, such as 2x1x1"
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

    def block_of(self, contracted: ArrayLike) -> NDArray[np.int64]:
        """The one block of every point: on an inner face the upper one, on the cube's faces the outermost.

        Args: contracted (N, 3) in [0, 1]. Returns (N,) block ids.
        Raises ValueError if a coordinate is not finite or outside the cube.
        """
        y = np.asarray(contracted, np.float64)
        if y.ndim != 2 or y.shape[1] != 3:
            raise ValueError(f"contracted points need the shape (N, 3), not {y.shape}")
        if not ((y >= 0.0) & (y <= 1.0)).all():  # false for NaN too
            raise ValueError("contracted points must lie in the unit cube")
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


@dataclass(frozen=True, eq=False)
class Cell:
    """One block's share of all space. Raises ValueError if the grid has no such block."""

    aabb: Aabb
    grid: Grid
    block: int

    def __post_init__(self) -> None:
        self.grid.bounds(self.block)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which world points (N, 3) belong to this block, (N,). Every finite point belongs to exactly one.

        Raises ValueError if a coordinate is not finite.
        """
        inside: NDArray[np.bool_] = self.grid.block_of(contract(points, self.aabb)) == self.block
        return inside
