"""The map of a run as data, which the page and plan.png draw: rasters, lines, marks and words.

A thousand cells cost as much to draw as two: they are one raster.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.block_colors import SEAM_GRADES, block_color, seam_grade
from panolog.partition.cells import Face, Grid
from panolog.partition.contraction import contract, expand
from panolog.partition.faces import Plane, planes_between
from panolog.partition.plan import Plan
from panolog.scene.ply_table import read_table, sky_of

_CELLS = 360  # samples of the cells along the longer side
_POINTS = 640  # the same of the points
_REACH = (1.15, 1.6)  # half extents of the AABB that are shown at least and at most
_SHAPE = (1.4, 1.7)  # width by height of a window: outer cells have no end, so any window can be filled
_LABELS = 80  # blocks in the window up to which each has a number
_RINGS = (9, 14, 18)  # pixels: a camera, and the rings around it for the second and the third block it trains
_RINGED = 1_500  # cameras up to which rings are drawn: each is a shape of its own
_LABEL_GRID = 24  # rows and columns of candidates for the position of a label
_ALONG = 120  # samples of a face between cells
_LEGEND = {  # what a part of the map is; the page and plan.png have a sign for each
    "cameras": "camera",
    "rings": "rings: other blocks that it trains",
    "points": "points",
    "fixes": "GPS",
    "box": "box, beyond which cells bend",
}

Figure = dict[str, Any]  # {"data": parts, "layout": axes, "blocks": numbers, colours and words}


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


def map_figure(
    plan: Plan,
    points: NDArray[np.floating],
    seams: Mapping[tuple[int, int], float] | None = None,
    *,
    planned: bool = True,
    fixes: NDArray[np.floating] = np.empty((0, 3)),  # noqa: B008  # never changed
) -> Figure:
    """A plan from above in world space: cells, points, faces, AABB, fixes of GPS and cameras.

    "blocks" has `planned`; `count` and `colors` of all blocks; `names` of cameras; parts and words of the
    `legend`, `grades` for that of seams; and for blocks on top of each other `layers`, the `layer` shown and
    the `stride` of ids between layers. The part "blocks" has the ids of the lowest layer as `z`.

    Args: points (P, 3) of the scene, such as those of `read_points`; seams of faces by their blocks; planned,
    False of an outline: its only block is none, and cameras without a name are fixes; fixes (F, 3).
    """
    view, seams = window_on(plan, points), seams or {}
    parts: list[Figure] = [
        _raster("blocks", view, view.cells.astype("<i2" if plan.grid.count < 2**15 else "<i4")),
        _raster("points", view, view.density(points)),
        _line("faces", view.faces()),
        *_seams(view, seams),
        _line("box", view.outline()[: None if planned else 0]),
        {"name": "fixes"} | _places(view, fixes.astype(float).round(3)),
        *_cameras(view, planned=planned),
        _labels(view, planned=planned),
    ]
    present = {"points", *(part["name"] for part in parts if part.get("x")), *(["rings"] if planned else [])}
    ranges = zip(view.axes, view.lower.tolist(), view.upper.tolist(), strict=False)
    axes = [{"title": {"text": f"{'xyz'[axis]} (world units)"}, "range": [*ends]} for axis, *ends in ranges]
    return {
        "data": parts,
        "layout": {"xaxis": axes[0], "yaxis": axes[1]},
        "blocks": {
            "planned": planned,
            "count": plan.grid.count,
            "colors": view.colors,
            "names": list(filter(None, plan.names)),
            "legend": [item for item in _LEGEND.items() if item[0] in present],
            "grades": _grades(seams.values()),
            "layers": view.layers,
            "layer": view.layer,
            "stride": view.stride,
        },
    }


def _raster(name: str, view: MapWindow, values: NDArray[Any]) -> Figure:
    """A raster of the window: its values, lowest row first, the first centre, and the step to the next."""
    step = (view.upper - view.lower) / values.shape[::-1]
    (x0, y0), (dx, dy) = (view.lower + step / 2).tolist(), step.tolist()
    return {"name": name, "z": values, "x0": x0, "dx": dx, "y0": y0, "dy": dy}


def _places(view: MapWindow, places: NDArray[np.floating]) -> dict[str, list[float]]:
    """Where points (P, 3) are on the map."""
    return {"x": places[:, view.axes[0]].tolist(), "y": places[:, view.axes[1]].tolist()}


def _line(name: str, points: NDArray[np.float64]) -> Figure:
    """A line through the points (L, 2), with a gap at each NaN."""
    x, y = ([None if np.isnan(v) else float(f"{v:.6g}") for v in column] for column in points.T)
    return {"name": name, "x": x, "y": y}


def _grades(seams: Iterable[float]) -> list[list[str]]:
    """Text and colour of each grade of seams that there is."""
    present, limits = {seam_grade(seam) for seam in seams}, [least for least, _ in SEAM_GRADES.values()]
    spans = [f"{low:g} to {high:g}" if low else f"below {high:g}" for low, high in pairwise(limits)]
    return [
        [f"seam {span}", color]
        for (name, (_, color)), span in zip(
            SEAM_GRADES.items(), [*spans, f"{limits[-1]:g} and more"], strict=True
        )
        if name in present
    ]


def _seams(view: MapWindow, seams: Mapping[tuple[int, int], float]) -> list[Figure]:
    """A thick line for each face whose seam was measured, the worst above all others."""
    planes = {(plane.below, plane.above): plane for plane in planes_between(view.plan.grid)} if seams else {}
    traces = []
    for blocks, seam in sorted(seams.items(), key=lambda item: item[1]):
        if (plane := planes.get(blocks)) is not None and plane.axis != view.axes[2]:
            text = f"seam between blocks {blocks[0]} and {blocks[1]}: {seam:.2f}"
            color = {"line": {"color": SEAM_GRADES[seam_grade(seam)][1]}}
            traces.append(_line("seams", view.line(plane)) | color | {"text": text})
    return traces


def _cameras(view: MapWindow, *, planned: bool) -> list[Figure]:
    """A disc for each camera in the colour of its own block, and rings for other blocks that it trains."""
    plan = view.plan
    blocks = [  # of each camera, its own first
        sorted(plan.assignment.blocks_of(k).tolist(), key=int(own).__ne__)
        for k, own in enumerate(plan.camera_blocks)
    ]
    size = float(np.clip(60 / max(len(blocks), 1) ** 0.5, 0.45, 1.0))
    traces = []
    for ring in reversed(range(len(_RINGS) if len(blocks) <= _RINGED else 1)):
        here = [k for k, its in enumerate(blocks) if len(its) > ring and plan.names[k]]
        marker = {
            "size": _RINGS[ring] * size,
            "color": [block_color(blocks[k][ring]) for k in here],
            "line": {"width": 1.2 * size},
        }
        trace = {"name": f"cameras, ring {ring}" if ring else "cameras", "marker": marker}
        texts = {"text": [planned * f"trains {_listed(blocks[k])}" for k in here]}
        traces.append(
            trace | texts | {"customdata": [plan.rows[k] for k in here]} | _places(view, plan.centers[here])
        )
    return traces


def _listed(blocks: Sequence[int]) -> str:
    head = ", ".join(map(str, sorted(blocks)[:8]))
    return f"block{'s' * (len(blocks) > 1)} {head}{', …' * (len(blocks) > 8)}"


def _labels(view: MapWindow, *, planned: bool) -> Figure:
    """Blocks, and where their numbers are, if there are not too many."""
    few = planned and len(np.unique(view.cells)) <= _LABELS
    ids, places = view.labels() if few else (np.empty(0, np.int64), np.empty((0, 2)))
    x, y = places.T.tolist()
    return {"name": "labels", "x": x, "y": y, "customdata": (ids + view.layer * view.stride).tolist()}


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
