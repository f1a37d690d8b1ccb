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
from panolog.orchestrator.views.plan_map import window_on
from panolog.partition.contraction import expand
from panolog.partition.plan import Plan
from panolog.scene.files import atomic

_RASTER = 500  # points along the longer side at which cells are sampled for their tint and labels
_ROOM = 30  # of these points must fit between the centre of a label and the edge of its cell
_POINTS = 60_000  # points of the scene drawn at most
_REACH = (1.3, 1.8)  # half extents of the AABB that the picture shows at least and at most
_INK, _GREY = "#22272e", "#6b7280"

Color = tuple[float, float, float]


def write_plan_picture(path: Path, plan: Plan, points: NDArray[np.floating]) -> None:
    """Writes a picture of a plan: cells, AABB, points and cameras with the blocks that they train.

    Seen along the axis on which the cameras spread least. Cells are those of the layer through the middle of
    the AABB; outside of it their faces bend, because the grid is regular in contracted space.

    Args: path of the PNG, written atomically; points (P, 3) of the scene, such as means, in world units.
    Raises OSError if it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    view = window_on(plan, points, _REACH, shape=None)
    (across, up, depth), low, high = view.axes, view.lower, view.upper
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(10, 10 * min(max(aspect, 0.45), 1.4) + 1.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel(f"{'xyz'[across]} (world units)", color=_GREY)
    axes.set_ylabel(f"{'xyz'[up]} (world units)", color=_GREY)
    axes.tick_params(colors=_GREY, labelsize=8)
    axes.spines[:].set_color("#d1d5db")
    blocks, extent = view.blocks(_RASTER), (low[0], high[0], low[1], high[1])
    _draw_cells(axes, plan, blocks, extent)
    _draw_points(axes, points[:, [across, up]])
    _draw_box(axes, plan, (across, up))
    _draw_cameras(axes, plan, plan.centers[:, [across, up]])
    _draw_labels(axes, plan, blocks, extent, (across, up))
    _draw_texts(axes, plan, depth)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_cells(
    axes: Axes, plan: Plan, blocks: NDArray[np.int64], extent: tuple[float, float, float, float]
) -> None:
    """Tints each cell in the colour of its block."""
    tints = np.array([[1 - 0.2 * (1 - part) for part in _color(plan, b)] for b in range(plan.grid.count)])
    axes.imshow(tints[blocks], extent=extent, origin="lower", interpolation="nearest", zorder=0)


def _draw_points(axes: Axes, points: NDArray[np.floating]) -> None:
    shown = points[:: max(1, -(-len(points) // _POINTS))]
    axes.scatter(shown[:, 0], shown[:, 1], s=1.2, c=_INK, alpha=0.35, linewidths=0, zorder=2)


def _draw_box(axes: Axes, plan: Plan, view: tuple[int, int]) -> None:
    """The AABB, and the faces between cells as the inverse contraction bends them."""
    lower, size = plan.aabb.lower[list(view)], 2 * plan.aabb.half[list(view)]
    axes.add_patch(
        Rectangle(
            (lower[0], lower[1]), size[0], size[1], fill=False, ec=_INK, ls=(0, (6, 4)), lw=1.2, zorder=3
        )
    )
    along = np.linspace(0.02, 0.98, 400)
    for fixed, free in (view, view[::-1]):
        for edge in plan.grid.edges[fixed][1:-1]:
            face = np.full((len(along), 3), 0.5)
            face[:, fixed], face[:, free] = edge, along
            world = expand(face, plan.aabb)
            axes.plot(world[:, view[0]], world[:, view[1]], color="white", lw=3, zorder=3)
            axes.plot(world[:, view[0]], world[:, view[1]], color=_INK, lw=1.2, zorder=3)


def _draw_cameras(axes: Axes, plan: Plan, places: NDArray[np.float64]) -> None:
    """A disc for each camera, with one sector in the colour of each block that it trains."""
    assigned = plan.assignment.assigned
    size = float(np.clip(9000 / max(len(places), 1), 12, 110))
    axes.scatter(places[:, 0], places[:, 1], s=size * 1.5, c="white", linewidths=0, zorder=5)
    for served in np.unique(assigned, axis=0):
        here = places[(assigned == served).all(axis=1)]
        ids = np.flatnonzero(served)
        for i, block in enumerate(ids):
            sector = _sector(360 * i / len(ids), 360 * (i + 1) / len(ids))
            # A marker is scaled to its own extent: this keeps a sector as large as the disc it is part of.
            scale = float(np.abs(sector.vertices).max()) ** 2
            axes.scatter(
                here[:, 0],
                here[:, 1],
                s=size * scale,
                marker=sector,
                color=_color(plan, int(block)),
                linewidths=0,
                zorder=6,
            )


def _sector(start: float, end: float) -> Outline:
    return Outline.unit_circle() if end - start >= 360 else Outline.wedge(start + 90, end + 90)


def _draw_labels(
    axes: Axes,
    plan: Plan,
    blocks: NDArray[np.int64],
    extent: tuple[float, float, float, float],
    view: tuple[int, int],
) -> None:
    """Number, cameras and Gaussians of each block, where its cell has most space without cameras."""
    rows, columns = blocks.shape
    origin, size = np.array([extent[0], extent[2]]), np.array([extent[1] - extent[0], extent[3] - extent[2]])
    pixels = ((plan.centers[:, list(view)] - origin) / size * [columns, rows]).astype(int)
    free = np.ones((rows, columns), bool)
    free[pixels[:, 1].clip(0, rows - 1), pixels[:, 0].clip(0, columns - 1)] = False
    for block in np.unique(blocks):
        room = np.pad((blocks == block) & free, 1).astype(np.uint8)
        distance = cv2.distanceTransform(room, cv2.DIST_L2, 5)[1:-1, 1:-1]
        row, column = np.unravel_index(np.argmax(distance), distance.shape)
        x, y = origin + (np.array([column, row]) + 0.5) / [columns, rows] * size
        axes.annotate(
            _label(plan, int(block), brief=bool(distance[row, column] < _ROOM)),
            (x, y),
            ha="center",
            va="center",
            fontsize=9,
            color=_INK,
            linespacing=1.4,
            zorder=8,
            bbox={"boxstyle": "round,pad=0.45", "fc": "white", "ec": _color(plan, int(block)), "alpha": 0.92},
        )


def _label(plan: Plan, block: int, *, brief: bool) -> str:
    if brief:
        return str(block)
    cameras, gaussians = len(plan.cameras(block)), int(plan.gaussians[block])
    return f"block {block}\n{_count(cameras, 'camera')}\n{_count(gaussians, 'Gaussian')}"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _draw_texts(axes: Axes, plan: Plan, depth: int) -> None:
    """Title, parameters and the legend."""
    config, third = plan.config, "xyz"[depth]
    overlap = plan.assignment.assigned.sum() / max(len(plan.rows), 1)
    axes.set_title(
        f"{plan.grid} blocks, {len(plan.rows)} cameras", loc="left", fontsize=15, color=_INK, pad=24
    )
    text = (
        f"seen along {third}   ·   baseline {plan.baseline:.3g}, margin {plan.baseline * config.rho_tri:.3g}"
        f"   ·   ρ_tri {config.rho_tri:g}, τ_grad {config.tau_grad:g}   ·   {overlap:.2f} blocks per camera"
    )
    if plan.grid.shape[depth] > 1:
        text += f"   ·   the layer through the middle, of {plan.grid.shape[depth]} along {third}"
    axes.text(0, 1.015, text, transform=axes.transAxes, fontsize=9, color=_GREY)
    handles = [
        Line2D([], [], ls="", marker="o", color=_GREY, label="camera; a sector for each block it trains"),
        Line2D([], [], color=_INK, ls=(0, (6, 4)), lw=1.2, label="AABB (eq. 9)"),
        Line2D([], [], color=_INK, lw=1.2, label="face between blocks"),
        Line2D([], [], ls="", marker=".", ms=3, color=_INK, label="points of the scene"),
    ]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=4, frameon=False, fontsize=8.5
    )


def _color(plan: Plan, block: int) -> Color:
    return to_rgb(block_color(block, plan.grid.count))
