"""A plan from above as rasters: which block each pixel belongs to, how far it is, and where points are.

A thousand cells cost as much to draw as two: they are one raster.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.palette import block_color
from panolog.partition.cells import Face, Grid
from panolog.partition.contraction import contract, expand
from panolog.partition.faces import Plane
from panolog.partition.plan import Plan
from panolog.scene.ply_table import read_table, sky_of

_CELLS = 360  # samples of the cells along the longer side
_POINTS = 640  # the same of the points
_REACH = (1.15, 1.6)  # half extents of the AABB that are shown at least and at most
_SHAPE = (1.4, 1.7)  # width by height of a window: outer cells have no end, so any window can be filled
LABELS = 80  # blocks in the window up to which each has a number
RINGS = (9, 14, 18)  # pixels: a camera, and the rings around it for the second and the third block it trains
_LABEL_GRID = 24  # rows and columns of candidates for the position of a label
_ALONG = 120  # samples of a face between cells


@dataclass(frozen=True, eq=False)
class MapWindow:
    """A window on a plan, seen along the axis on which its cameras spread least."""

    plan: Plan
    axes: tuple[int, int, int]  # across, up, and the viewing direction
    lower: NDArray[np.float64]  # (2,) world units
    upper: NDArray[np.float64]  # (2,)

    @property
    def layers(self) -> int:
        """Cells on top of each other."""
        return self.plan.grid.shape[self.axes[2]] if isinstance(self.plan.grid, Grid) else 1

    @property
    def stride(self) -> int:
        """The difference between the ids of blocks on top of each other."""
        grid = self.plan.grid
        return int(np.prod(grid.shape[: self.axes[2]])) if isinstance(grid, Grid) else 1

    @cached_property
    def layer(self) -> int:
        """The layer in which most cameras are, the lowest is 0."""
        layers = self.plan.camera_blocks // self.stride % self.layers
        return int(np.bincount(layers, minlength=self.layers).argmax())

    @property
    def colors(self) -> list[str]:
        """The colours of all blocks."""
        return [block_color(block) for block in range(self.plan.grid.count)]

    @cached_property
    def cells(self) -> NDArray[np.int64]:
        """(rows, columns) the block of the lowest layer at each sample, lowest row first.

        Faces are drawn as they run through the middle of the AABB, in every layer alike.
        """
        x, y = self.samples(_CELLS)
        world = np.tile(self.plan.aabb.center, (len(y), len(x), 1))
        world[..., self.axes[0]], world[..., self.axes[1]] = np.meshgrid(x, y)
        contracted = contract(world.reshape(-1, 3), self.plan.aabb)
        middle = self.plan.grid.block_of(contracted).reshape(len(y), len(x))
        return middle - middle // self.stride % self.layers * self.stride

    def samples(self, longer: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World coordinates of the columns and rows of a picture with `longer` pixels on its longer side."""
        size = self.upper - self.lower
        counts = np.maximum((longer * size / size.max()).astype(int), 2)
        x, y = (self.lower[i] + (np.arange(counts[i]) + 0.5) / counts[i] * size[i] for i in range(2))
        return x, y

    def density(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """(rows, columns) how many of the points (P, 3) fall on each pixel: log scale, 255 the most."""
        x, y = self.samples(_POINTS)
        bounds = list(zip(self.lower[::-1], self.upper[::-1], strict=True))
        flat = points[:, [self.axes[1], self.axes[0]]]
        counts = np.histogram2d(flat[:, 0], flat[:, 1], bins=(len(y), len(x)), range=bounds)[0]
        logs = np.log1p(counts)
        # The densest few pixels must not make all others faint.
        most = np.percentile(logs[logs > 0], 98) if (logs > 0).any() else 1.0
        density: NDArray[np.uint8] = (255 * np.minimum(logs / most, 1)).round().astype(np.uint8)
        return density

    def faces(self) -> NDArray[np.float64]:
        """(F, 2) points of the lines between cells, each line followed by a row of NaN."""
        lines = [self.line(face) for face in self.plan.grid.faces if face.axis != self.axes[2]]
        gap = np.full((1, 2), np.nan)
        return np.concatenate([np.empty((0, 2)), *(part for line in lines for part in (line, gap))])

    def outline(self) -> NDArray[np.float64]:
        """(5, 2) the AABB."""
        pair = list(self.axes[:2])
        (left, bottom), (right, top) = self.plan.aabb.lower[pair], self.plan.aabb.upper[pair]
        return np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])

    def line(self, face: Face | Plane) -> NDArray[np.float64]:
        """(F, 2) points of a face that is not seen from its front."""
        across, up, _ = self.axes
        free = up if face.axis == across else across
        line = np.full((_ALONG, 3), 0.5)
        line[:, face.axis] = face.at
        line[:, free] = np.linspace(face.lower[free], face.upper[free], _ALONG).clip(0.01, 0.99)
        return expand(line, self.plan.aabb)[:, [across, up]]

    def labels(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The (M,) blocks of the lowest layer in the window, and the positions (M, 2) of their labels.

        Each is the candidate farthest from cameras, other cells and the edge of the window.
        """
        x, y = (axis[:: max(len(axis) // _LABEL_GRID, 1)] for axis in self.samples(_CELLS))
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        rows, columns = (max(count // _LABEL_GRID, 1) for count in self.cells.shape)
        blocks = self.cells[::rows, ::columns]
        flat = blocks.ravel()
        room = np.minimum(places - self.lower, self.upper - places).min(axis=1)
        cameras = self.plan.centers[:: max(len(self.plan.centers) // 500, 1), list(self.axes[:2])]
        ids = np.unique(flat)
        best = np.empty((len(ids), 2))
        for i, block in enumerate(ids):
            mine = np.flatnonzero(flat == block)
            others = np.concatenate([cameras, places[flat != block]])
            away = np.linalg.norm(places[mine, None] - others[None], axis=2).min(axis=1, initial=np.inf)
            best[i] = places[mine[np.argmax(np.minimum(room[mine], away))]]
        return ids, best


def served(plan: Plan, k: int) -> list[int]:
    """The blocks that the k-th camera trains, its own first."""
    return sorted(plan.assignment.blocks_of(k).tolist(), key=lambda b: b != plan.camera_blocks[k])


def window_on(plan: Plan, points: NDArray[np.floating]) -> MapWindow:
    """The window that shows the AABB and most of the points (P, 3), but not much more than the AABB."""
    depth = int(np.argmin(np.ptp(plan.centers, axis=0)))
    across, up = (axis for axis in range(3) if axis != depth)
    pair = [across, up]
    center, half = plan.aabb.center[pair], plan.aabb.half[pair]
    extents = np.full(2, _REACH[0])
    if len(points):
        offsets = np.abs(points[:, pair] - center) / half
        extents = np.clip(np.percentile(offsets, 98, axis=0), *_REACH)
    size = extents * half
    size[0] = max(size[0], _SHAPE[0] * size[1])
    size[1] = max(size[1], size[0] / _SHAPE[1])
    return MapWindow(plan, (across, up, depth), center - size, center + size)


def read_points(ply: Path, most: int = 200_000) -> NDArray[np.float32]:
    """(P, 3) about `most` means of the Gaussians in a PLY, evenly thinned, without its sky.

    Raises InputError if it is no whole PLY.
    """
    table = read_table(ply)
    scene = table.count - sky_of(table)
    if not scene:
        return np.empty((0, 3), np.float32)
    rows = np.memmap(ply, table.dtype, "r", table.offset, (scene,))[:: -(-scene // most)]
    points = np.stack([rows[axis] for axis in "xyz"], axis=1)
    finite: NDArray[np.float32] = points[np.isfinite(points).all(axis=1)].astype(np.float32)
    return finite
