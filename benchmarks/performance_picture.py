"""The picture of docs/performance.md."""

import io
from collections.abc import Sequence
from dataclasses import fields

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.fit import Fit
from benchmarks.growth import Growth, Point
from benchmarks.iteration import Times
from benchmarks.rasterizer import Row

COLORS = {"forward": "#4477aa", "backward": "#66ccee", "loss": "#ccbb44", "adam": "#bbbbbb"}


def draw(rows: Sequence[Row], growth: Growth) -> bytes:
    """An SVG: what iterations are made of (rows on most threads), and both lines of growth."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.4, 1, 1])
    most = max(row.threads for row in rows)
    _parts(left, [row for row in rows if row.threads == most])
    _line(middle, growth.by_pixels, "pixels", growth.pixels())
    _line(right, growth.by_gaussians, "gaussians", growth.gaussians())
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "panolog", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _parts(axes: Axes, rows: Sequence[Row]) -> None:
    """Bars of shares, as milliseconds differ too much."""
    names = [field.name for field in fields(Times) if field.name in COLORS]
    labels = [f"{row.model}, {row.width}, {row.gaussians:,}" for row in rows]
    start = [0.0] * len(rows)
    for name in sorted(names, key=list(COLORS).index):
        parts = [getattr(row.times, name) for row in rows]
        wholes = [row.times.rasterization + row.times.loss + row.times.adam for row in rows]
        shares = [100 * part / whole for part, whole in zip(parts, wholes, strict=True)]
        axes.barh(labels, shares, left=start, color=COLORS[name], label=name)
        start = [before + share for before, share in zip(start, shares, strict=True)]
    axes.invert_yaxis()
    axes.axvline(70, color="black", linewidth=0.8, linestyle=":")
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of an iteration")
    axes.tick_params(axis="y", labelsize=7)
    axes.legend(ncols=4, fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


def _line(axes: Axes, points: Sequence[Point], column: str, line: Fit) -> None:
    """Points and their line."""
    millions = [getattr(point, column) / 1e6 for point in points]
    axes.plot(millions, [point.milliseconds for point in points], "o", color="#4477aa")
    ends = [0.0, max(millions)]
    axes.plot(ends, [line(**{column: end}) for end in ends], color="#bbbbbb", zorder=0)
    axes.set_xlabel(f"million {'Gaussians' if column == 'gaussians' else column}")
    axes.set_ylabel("iteration, ms")
    axes.set_title(f"R² {line.r2:.4f}", fontsize=9)
    axes.set_ylim(bottom=0)
