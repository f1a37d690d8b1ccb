"""plan.png: a partition seen from above, in world space."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from panolog.orchestrator.views.palette import block_color
from panolog.orchestrator.views.plan_map import MapWindow, window_on
from panolog.partition.plan import Plan
from panolog.scene.files import atomic

_WIDTH = 10.0  # of the picture, inches
_RASTER = 500  # samples along the longer side, for the tints of cells and the places of labels
_POINTS = 60_000  # points of the scene drawn at most
_REACH = (1.3, 1.8)  # half extents of the AABB that the picture shows at least and at most
_SHAPE = (0.8, 2.6)  # least and largest width by height of what it shows
_FULL, _BRIEF = (1.6, 0.75), (0.35, 0.35)  # inches that the label of a block takes, and its number alone
_INK, _GREY = "#22272e", "#59616d"

Color = tuple[float, float, float]


def write_plan_picture(path: Path, plan: Plan, points: NDArray[np.floating]) -> None:
    """Writes a picture of a plan, atomically: see `plan_figure`. Raises OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = plan_figure(plan, points)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png")


def plan_figure(plan: Plan, points: NDArray[np.floating]) -> Figure:
    """A plan from above: cells, AABB, points and cameras with the blocks that they train.

    Seen along the axis on which the cameras spread least. Cells are those of the layer through the middle of
    the AABB; outside of it their faces bend, because they are plane in contracted space.

    Args: points (P, 3) of the scene, such as means, in world units.
    """
    view = window_on(plan, points, _REACH, _SHAPE)
    (across, up, _), low, high = view.axes, view.lower, view.upper
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(_WIDTH, _WIDTH * aspect + 1.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel(f"{'xyz'[across]} (world units)", color=_GREY)
    axes.set_ylabel(f"{'xyz'[up]} (world units)", color=_GREY)
    axes.tick_params(colors=_GREY, labelsize=8)
    axes.spines[:].set_color("#d1d5db")
    blocks, flat = view.blocks(_RASTER), points[:, [across, up]]
    _draw_cells(axes, plan, blocks, (low[0], high[0], low[1], high[1]))
    _draw_points(axes, flat)
    _draw_box(axes, plan, view)
    _draw_cameras(axes, plan, plan.centers[:, [across, up]])
    _draw_labels(axes, view, blocks, flat)
    _draw_texts(figure, axes, view)
    return figure


def _draw_cells(
    axes: Axes, plan: Plan, blocks: NDArray[np.int64], extent: tuple[float, float, float, float]
) -> None:
    """Tints each cell in the colour of its block."""
    tints = np.array([[1 - 0.2 * (1 - part) for part in _color(b)] for b in range(plan.grid.count)])
    axes.imshow(tints[blocks], extent=extent, origin="lower", interpolation="nearest", zorder=0)


def _draw_points(axes: Axes, points: NDArray[np.floating]) -> None:
    shown = points[:: max(1, -(-len(points) // _POINTS))]
    axes.scatter(shown[:, 0], shown[:, 1], s=1.2, c=_INK, alpha=0.35, linewidths=0, zorder=2)


def _draw_box(axes: Axes, plan: Plan, view: MapWindow) -> None:
    """The AABB, and the faces between cells as the inverse contraction bends them."""
    shown = list(view.axes[:2])
    lower, size = plan.aabb.lower[shown], 2 * plan.aabb.half[shown]
    axes.add_patch(
        Rectangle(
            (lower[0], lower[1]), size[0], size[1], fill=False, ec=_INK, ls=(0, (6, 4)), lw=1.2, zorder=3
        )
    )
    x, y = view.faces().T
    axes.plot(x, y, color="white", lw=3, zorder=3)
    axes.plot(x, y, color=_INK, lw=1.2, zorder=3)


def _draw_cameras(axes: Axes, plan: Plan, places: NDArray[np.float64]) -> None:
    """A disc for each camera, with one sector in the colour of each block that it trains."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for k in range(len(plan.rows)):
        groups.setdefault(tuple(plan.assignment.blocks_of(k).tolist()), []).append(k)
    size = float(np.clip(9000 / max(len(places), 1), 12, 110))
    axes.scatter(places[:, 0], places[:, 1], s=size * 1.5, c="white", linewidths=0, zorder=5)
    for ids, group in sorted(groups.items()):
        here = places[group]
        for i, block in enumerate(ids):
            sector = _sector(360 * i / len(ids), 360 * (i + 1) / len(ids))
            # A marker is scaled to its own extent: this keeps a sector as large as the disc it is part of.
            scale = float(np.abs(sector.vertices).max()) ** 2
            axes.scatter(
                here[:, 0],
                here[:, 1],
                s=size * scale,
                marker=sector,
                color=_color(int(block)),
                linewidths=0,
                zorder=6,
            )


def _sector(start: float, end: float) -> Outline:
    return Outline.unit_circle() if end - start >= 360 else Outline.wedge(start + 90, end + 90)


def _draw_labels(
    axes: Axes, view: MapWindow, blocks: NDArray[np.int64], points: NDArray[np.floating]
) -> None:
    """Number, cameras and Gaussians of each block where that hides no camera, and little else.

    Of a cell without room for that the number alone; nothing if not even the number has room.
    """
    shape, plan = blocks.shape, view.plan
    cameras = _counted(view, plan.centers[:, list(view.axes[:2])], shape) > 0
    radius = int(np.ceil(_RASTER / _WIDTH * 0.1))  # of a camera's disc
    taken = cv2.dilate(cameras.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8))
    density = np.log1p(_counted(view, points, shape)).astype(np.float32)
    size = view.upper - view.lower
    box = np.array([plan.aabb.lower, plan.aabb.upper])[:, list(view.axes[:2])]
    first, last = ((box - view.lower) / size * shape[::-1]).astype(int).tolist()
    cv2.rectangle(density, first, last, 1.0)
    for block in np.unique(blocks):
        free = (blocks == block) & (taken == 0)
        full = _place(free, density, _FULL)
        place = full or _place(free, density, _BRIEF)
        if place is None:
            continue
        x, y = view.lower + (np.array(place) + 0.5) / shape[::-1] * size
        axes.annotate(
            _label(plan, int(block)) if full else str(block),
            (x, y),
            ha="center",
            va="center",
            fontsize=9,
            color=_INK,
            linespacing=1.4,
            zorder=8,
            bbox={"boxstyle": "round,pad=0.4", "fc": "white", "ec": _color(int(block)), "lw": 1.5},
        )


def _counted(view: MapWindow, points: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(rows, columns) how many of the points (P, 2) lie on each sample of the window, lowest row first."""
    bounds = [(view.lower[1], view.upper[1]), (view.lower[0], view.upper[0])]
    counts: NDArray[np.float64] = np.histogram2d(points[:, 1], points[:, 0], bins=shape, range=bounds)[0]
    return counts


def _place(
    free: NDArray[np.bool_], density: NDArray[np.float32], inches: tuple[float, float]
) -> tuple[int, int] | None:
    """Column and row of the centre of a label that lies on free samples only, with the least points below."""
    width, height = (int(np.ceil(side * _RASTER / _WIDTH)) | 1 for side in inches)
    room = cv2.erode(np.pad(free, 1).astype(np.uint8), np.ones((height, width), np.uint8), borderValue=0)[
        1:-1, 1:-1
    ]
    if not room.any():
        return None
    below = cv2.boxFilter(density, -1, (width, height), borderType=cv2.BORDER_CONSTANT)
    away = cv2.distanceTransform(np.pad(free, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    cost = np.where(room > 0, below - 1e-4 * away, np.inf)
    row, column = np.unravel_index(np.argmin(cost), cost.shape)
    return int(column), int(row)


def _label(plan: Plan, block: int) -> str:
    cameras, gaussians = len(plan.cameras(block)), int(plan.gaussians[block])
    return f"block {block}\n{_count(cameras, 'camera')}\n{_count(gaussians, 'Gaussian')}"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _draw_texts(figure: Figure, axes: Axes, view: MapWindow) -> None:
    """Title, parameters and the legend, each in a place of its own."""
    plan, third = view.plan, "xyz"[view.axes[2]]
    config = plan.config
    title = f"{_count(plan.grid.count, 'block')} ({plan.grid}), {_count(len(plan.rows), 'camera')}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, color=_INK)
    text = f"seen along {third}   ·   {plan.assignment.overlap:.2f} blocks per camera"
    if view.layers > 1:
        text += f"   ·   the layer through the middle, of {view.layers} along {third}"
    text += (
        f"\nbaseline {plan.baseline:.3g}, margin {plan.baseline * config.rho_tri:.3g}"
        f"   ·   ρ_tri {config.rho_tri:g}, τ_grad {config.tau_grad:g}"
    )
    axes.set_title(text, loc="left", fontsize=9, color=_GREY, linespacing=1.5)
    handles = [
        Line2D([], [], ls="", marker="o", color=_GREY, label="camera; a sector for each block it trains"),
        Line2D([], [], color=_INK, ls=(0, (6, 4)), lw=1.2, label="AABB (eq. 9)"),
        Line2D([], [], color=_INK, lw=1.2, label="face between blocks"),
        Line2D([], [], ls="", marker=".", ms=3, color=_INK, label="points of the scene"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8.5)


def _color(block: int) -> Color:
    return to_rgb(block_color(block))
