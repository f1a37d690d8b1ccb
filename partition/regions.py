"""Regions: parts of a merged model that are trained once more, what is near faces apart from the cells."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cells
from panolog.partition.contraction import contract
from panolog.partition.faces import Plane


@dataclass(frozen=True, eq=False)
class Regions:
    """Parts of space without gap or overlap: the margins of faces, then what is left of each cell.

    A place belongs to the margin of the face of its cell that it is nearest to, if that is within `reach`,
    else to its cell. Without faces the regions are the cells.
    """

    aabb: Aabb
    cells: Cells
    faces: tuple[Plane, ...]
    reach: float  # world units, as `Plane.offsets` has them

    def of(self, points: ArrayLike) -> NDArray[np.int64]:
        """(N,) the region of world points (N, 3): a face, or the number of faces plus a cell.

        Raises ValueError if a coordinate is not finite.
        """
        positions = np.asarray(points, np.float64)
        cells = self.cells.block_of(contract(positions, self.aabb))
        found: NDArray[np.int64] = cells + len(self.faces)
        for cell in np.unique(cells).tolist():
            if numbers := self._around.get(cell):
                rows = np.flatnonzero(cells == cell)
                offsets = [self.faces[i].offsets(positions[rows], self.aabb) for i in numbers]
                away = np.nan_to_num(np.abs(np.stack(offsets)), nan=np.inf)
                near = away.min(axis=0) < self.reach
                found[rows[near]] = np.array(numbers)[away.argmin(axis=0)[near]]
        return found

    @cached_property
    def _around(self) -> dict[int, list[int]]:
        """The faces of each cell that has some."""
        found: dict[int, list[int]] = {}
        for number, face in enumerate(self.faces):
            for cell in (face.below, face.above):
                found.setdefault(cell, []).append(number)
        return found

    def margin(self, face: int) -> "Region":
        """One of them."""
        return Region(self, face)


@dataclass(frozen=True, eq=False)
class Region:
    """What is near a face."""

    regions: Regions
    number: int  # of the face

    def __str__(self) -> str:
        face = self.regions.faces[self.number]
        return f"the face between blocks {face.below} and {face.above}"

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """(N,) which world points (N, 3) are in it. Raises ValueError if a coordinate is not finite."""
        return np.asarray(self.regions.of(points) == self.number)
