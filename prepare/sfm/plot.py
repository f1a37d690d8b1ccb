"""sfm.png: where the panoramas of a reconstruction are, and how well each is constrained."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.scene.files import atomic

_INK, _GREY, _BLUE, _RED = "#22272e", "#6b7280", "#1d6fb8", "#c2410c"
_SOURCES = (_BLUE, "#309c9c", "#b400c0", "#849048", "#6c3cfc", "#786c60")  # the colour of each, in turn
_NAMED = 12  # sources in the legend
_POINTS = 60_000  # drawn at most
_MARGINS = (0.15, 1.2)  # of the trajectory's extent that is shown around it, at least and at most
_LABEL = (0.08, 0.02)  # of the plan's width and height: of labels that are nearer, the weaker link has one


def write_sfm_plot(path: Path, found: Reconstruction, weak: float) -> None:
    """Writes the trajectory, along the axis of its least extent, and how many points each panorama sees.

    Args: path of the PNG, written atomically; weak, the scale error from which a link is marked.
    Raises OSError if it cannot be written.
    """
    centers = found.model.centers
    depth = int(np.argmin(np.ptp(centers, axis=0)))
    across, up = (axis for axis in range(3) if axis != depth)
    low, high = _window(centers[:, [across, up]], found.model.points[:, [across, up]])
    aspect = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.4, 1.2))
    figure = Figure(figsize=(10, 10 * aspect + 3.2), dpi=150, layout="constrained")
    plan, bars = figure.subplots(2, 1, height_ratios=[10 * aspect, 2])
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    plan.set_xlabel(f"{'xyz'[across]} (world units)", color=_GREY)
    plan.set_ylabel(f"{'xyz'[up]} (world units)", color=_GREY)
    shown = found.model.points[:: max(1, -(-len(found.model.points) // _POINTS))]
    plan.scatter(shown[:, across], shown[:, up], s=1.2, c=_INK, alpha=0.25, linewidths=0)
    _draw_cameras(plan, centers[:, [across, up]], found)
    _draw_links(plan, centers[:, [across, up]], found, weak)
    plan.set_title(
        f"{len(centers)} of {len(found.panoramas)} panoramas, {len(found.model.points):,} points",
        loc="left",
        color=_INK,
    )
    _draw_bars(bars, found)
    for axes in (plan, bars):
        axes.tick_params(colors=_GREY, labelsize=8)
        axes.spines[:].set_color("#d1d5db")
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", bbox_inches="tight")


def _window(
    places: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(2,) lower and upper limits around the cameras (K, 2) and most of the points (P, 2)."""
    low, high = places.min(axis=0), places.max(axis=0)
    extent = max(float((high - low).max()), 1e-6)
    least, most = (margin * extent for margin in _MARGINS)
    first, last = np.percentile(points, (3, 97), axis=0)
    return np.clip(first, low - most, low - least), np.clip(last, high + least, high + most)


def _draw_cameras(axes: Axes, places: NDArray[np.float64], found: Reconstruction) -> None:
    """The trajectory of each source in the order of capture; of a sole one with the first and last name."""
    colors, labels = _colors(found), [found.panoramas[row].source for row in found.model.rows]
    for label, color in colors.items():
        own = places[[place for place, it in enumerate(labels) if it == label]]
        axes.plot(own[:, 0], own[:, 1], color=color, lw=0.8, alpha=0.6, zorder=3)
        axes.scatter(own[:, 0], own[:, 1], s=14, c=color, linewidths=0, zorder=4, label=label)
    if len(colors) > 1:
        handles, names = axes.get_legend_handles_labels()
        more = f", and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        names = [*names[: _NAMED - 1], names[_NAMED - 1] + more] if more else names
        axes.legend(handles[:_NAMED], names, frameon=False, fontsize=8, labelcolor=_INK, loc="best")
        return
    for row in dict.fromkeys((0, len(places) - 1)):
        name = found.panoramas[found.model.rows[row]].name
        axes.annotate(name, places[row], xytext=(5, 5), textcoords="offset points", color=_BLUE, fontsize=8)


def _colors(found: Reconstruction) -> dict[str, str]:
    """The colour of each source by its label, in the order of capture."""
    labels = dict.fromkeys(panorama.source for panorama in found.panoramas)
    return {label: _SOURCES[row % len(_SOURCES)] for row, label in enumerate(labels)}


def _draw_links(axes: Axes, places: NDArray[np.float64], found: Reconstruction, weak: float) -> None:
    """The links across which the scale may jump, and the pairs whose poses contradict their matches."""
    of_row = dict(zip(found.model.rows, places, strict=True))
    inside = [pair for pair in found.contradictions if of_row.keys() >= set(pair.between)]
    for pair in inside:
        ends = np.array([of_row[row] for row in pair.between])
        axes.plot(ends[:, 0], ends[:, 1], color=_RED, lw=1.5, ls=(0, (2, 2)), zorder=5)
    if inside:
        names = " and ".join(found.panoramas[row].name for row in inside[0].between)
        axes.set_title(f"{names} contradict each other", loc="right", color=_RED, fontsize=8)
    weakest = [link for link in found.links if link.scale_error >= weak]
    room = np.abs(np.subtract(*np.transpose([axes.get_xlim(), axes.get_ylim()]))) * _LABEL
    labelled = list[NDArray[np.float64]]()
    for link in weakest:
        ends = places[list(link.between)]
        axes.plot(ends[:, 0], ends[:, 1], color=_RED, lw=3, zorder=5, solid_capstyle="round")
        middle = ends.mean(axis=0)
        if all((np.abs(middle - other) > room).any() for other in labelled):
            text = f"±{link.scale_error:.1%}" if np.isfinite(link.scale_error) else "±?"
            axes.annotate(text, middle, xytext=(8, -12), textcoords="offset points", color=_RED, fontsize=8)
            labelled.append(middle)
    if weakest:
        what = "Weak links, and by how much the scale may jump there"
        axes.text(0.01, 0.01, what, transform=axes.transAxes, color=_RED, fontsize=8)


def _draw_bars(axes: Axes, found: Reconstruction) -> None:
    """How many points each panorama sees; those without a pose are marked."""
    seen = np.zeros(len(found.panoramas))
    seen[list(found.model.rows)] = [len(rows) for rows, _ in found.model.sightings]
    colors = _colors(found)
    shades = [colors[panorama.source] for panorama in found.panoramas] if len(colors) > 1 else _BLUE
    axes.bar(np.arange(len(seen)), seen, width=0.8, color=shades, alpha=0.7)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylabel("points seen", color=_GREY)
    axes.set_xlabel(f"panoramas by {'name' if len(colors) == 1 else 'source and time'}", color=_GREY)
    axes.margins(x=0.01)
    if found.missing:
        lost = list(found.missing)
        axes.plot(lost, np.zeros(len(lost)), "x", color=_RED, ms=6, clip_on=False, label="not registered")
        axes.legend(frameon=False, fontsize=8, labelcolor=_RED)
