"""plan.png: the map of a partition as a picture, for who has no page: see `figures.map_figure`."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from panolog.orchestrator.runs.units import counted
from panolog.orchestrator.watch.views.palette import block_color
from panolog.orchestrator.watch.views.plan_map import LABELS, RINGS, MapWindow, served, window_on
from panolog.partition.plan import Plan
from panolog.scene.files import atomic

_WIDTH = 10.0  # of the picture, inches
_COUNTED = 4  # blocks up to which the numbers of each are above the map
_INK, _GREY = "#22272e", "#59616d"


def write_plan_picture(path: Path, plan: Plan, points: NDArray[np.floating]) -> None:
    """Writes a picture of a plan, atomically: see `plan_figure`. Raises OSError if it cannot be written."""
    figure = plan_figure(plan, points)
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png")


def plan_figure(plan: Plan, points: NDArray[np.floating]) -> Figure:
    """A plan from above: cells in the colours of their blocks, AABB, points, cameras with rings, numbers.

    Args: points (P, 3) of the scene, such as means, in world units.
    """
    view = window_on(plan, points)
    low, high = view.lower, view.upper
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(_WIDTH, _WIDTH * aspect + 1.2), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_xlabel(f"{'xyz'[view.axes[0]]} (world units)", color=_GREY)
    axes.set_ylabel(f"{'xyz'[view.axes[1]]} (world units)", color=_GREY)
    axes.tick_params(colors=_GREY, labelsize=8)
    axes.spines[:].set_color("#d1d5db")
    _draw_rasters(axes, view, points)
    for line, style in ((view.faces(), "-"), (view.outline(), (0, (6, 4)))):
        axes.plot(line[:, 0], line[:, 1], color=_INK, lw=1.2, ls=style, zorder=3)
    _draw_cameras(axes, view)
    _draw_labels(axes, view)
    _draw_texts(figure, axes, view)
    return figure


def _draw_rasters(axes: Axes, view: MapWindow, points: NDArray[np.floating]) -> None:
    """The cells, tinted in the colours of their blocks, and the points."""
    tints = np.array([[1 - 0.2 * (1 - part) for part in to_rgb(color)] for color in view.colors])
    density = np.zeros((*(shares := view.density(points) / 255).shape, 4))
    density[..., :3], density[..., 3] = to_rgb(_INK), 0.7 * shares
    extent = (view.lower[0], view.upper[0], view.lower[1], view.upper[1])
    for raster in (tints[view.cells + view.layer * view.stride], density):
        axes.imshow(raster, extent=extent, origin="lower", interpolation="nearest")


def _draw_cameras(axes: Axes, view: MapWindow) -> None:
    """A disc for each camera in the colour of its own block, and rings for other blocks that it trains."""
    plan = view.plan
    blocks = [served(plan, k) for k in range(len(plan.rows))]
    size = float(np.clip(60 / max(len(blocks), 1) ** 0.5, 0.3, 1.0))
    for ring, diameter in reversed(list(enumerate(RINGS))):
        here = [k for k, its in enumerate(blocks) if len(its) > ring]
        x, y = plan.centers[here][:, list(view.axes[:2])].T
        colors = [block_color(blocks[k][ring]) for k in here]
        axes.scatter(x, y, s=(0.8 * diameter * size) ** 2, c=colors, ec="white", lw=size, zorder=5)


def _draw_labels(axes: Axes, view: MapWindow) -> None:
    """The number of each cell, if there are not too many."""
    ids, places = view.labels()
    for block, place in zip(ids + view.layer * view.stride, places, strict=True):
        if len(ids) <= LABELS:
            box = {"boxstyle": "round,pad=0.4", "fc": "white", "ec": block_color(int(block)), "lw": 1.5}
            axes.text(
                place[0], place[1], str(block), ha="center", va="center", fontsize=9, bbox=box, zorder=6
            )


def _draw_texts(figure: Figure, axes: Axes, view: MapWindow) -> None:
    """Title, parameters and the legend, each in a place of its own."""
    plan, third = view.plan, "xyz"[view.axes[2]]
    config = plan.config
    title = f"{counted(plan.grid.count, 'block')} ({plan.grid}), {counted(len(plan.rows), 'camera')}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, color=_INK)
    text = f"seen along {third}   ·   {plan.assignment.overlap:.2f} blocks per camera"
    if view.layers > 1:
        text += f"   ·   layer {view.layer + 1} of {view.layers} along {third}"
    text += (
        f"\nbaseline {plan.baseline:.3g}, margin {plan.baseline * config.rho_tri:.3g}"
        f"   ·   ρ_tri {config.rho_tri:g}, τ_grad {config.tau_grad:g}"
    )
    if plan.grid.count <= _COUNTED:
        text += "\n" + "   ·   ".join(
            f"{block}: {counted(len(plan.cameras(block)), 'camera')}, {counted(int(own), 'Gaussian')}"
            for block, own in enumerate(plan.gaussians)
        )
    axes.set_title(text, loc="left", fontsize=9, color=_GREY, linespacing=1.5)
    handles = [
        Line2D([], [], ls="", marker="o", color=_GREY, label="camera; a ring for each other block it trains"),
        Line2D([], [], color=_INK, ls=(0, (6, 4)), lw=1.2, label="AABB (eq. 9)"),
        Line2D([], [], color=_INK, lw=1.2, label="face between blocks"),
        Line2D([], [], ls="", marker=".", ms=3, color=_INK, label="points of the scene"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=8.5)
