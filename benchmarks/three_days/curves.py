"""The curves of a simulated run over simulated time, as a picture."""

import math
from collections.abc import Sequence
from itertools import groupby, pairwise
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.three_days.life import Sample
from panolog.scene.files import atomic

_INK, _GREY, _RULE = "#22272e", "#59616d", "#d1d5db"
_COLORS = ("#3c6c90", "#b400c0")
_NARROW = 6.0  # inches, below which there is one column
Curve = list[tuple[float, float]]  # hours, value
_PANELS: dict[str, tuple[str, ...]] = {  # fields of a sample by title
    "tasks that run": ("running",),
    "blocks done": ("done",),
    "nodes: alive (blue), in quarantine (purple)": ("nodes", "quarantined"),
    "driver memory, MB": ("memory",),
    "open descriptors": ("descriptors",),
    "run.db, MB": ("database",),
    "run folder, MB": ("disk",),
    "driver CPU, seconds per simulated hour": ("cpu",),
}


def write_curves(path: Path, samples: Sequence[Sample], title: str, width: float = 10.0) -> None:
    """Writes the picture, as SVG or PNG by its suffix. Args: width in inches; narrow ones have one column."""
    columns = 1 if width < _NARROW else 2
    rows = math.ceil(len(_PANELS) / columns)
    figure = Figure(figsize=(width, 1.9 * rows + 0.5), dpi=100, layout="constrained")
    figure.suptitle(title, color=_INK, fontsize=10, x=0.01, ha="left")
    drivers = [list(group) for _, group in groupby(samples, key=lambda sample: sample.driver)]
    for number, (name, fields) in enumerate(_PANELS.items()):
        axes = figure.add_subplot(rows, columns, number + 1)
        _panel(axes, name, [[_curve(driver, field) for driver in drivers] for field in fields])
        for driver in drivers[:-1]:
            axes.axvline(driver[-1].hours, color=_GREY, lw=0.8, ls=":")
        axes.set_xlim(0, samples[-1].hours * 1.01)
        if number >= len(_PANELS) - columns:
            axes.set_xlabel("simulated hours; dotted: another driver takes over", color=_GREY, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lstrip("."))


def _panel(axes: Axes, name: str, fields: Sequence[Sequence[Curve]]) -> None:
    for color, curves in zip(_COLORS, fields, strict=False):
        for curve in curves:
            axes.plot(*zip(*curve, strict=True), color=color, lw=1.2)
    axes.set_title(name, color=_INK, fontsize=9, loc="left")
    axes.set_ylim(bottom=0)
    axes.grid(color=_RULE, lw=0.5)
    axes.tick_params(colors=_GREY, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_RULE)


def _curve(driver: Sequence[Sample], field: str) -> Curve:
    """One field of the samples of one driver."""
    if field == "cpu":
        return [
            (b.hours, (b.cpu - a.cpu) / (b.hours - a.hours)) for a, b in pairwise(driver) if b.hours > a.hours
        ]
    scale = 1e6 if field in ("memory", "database", "disk") else 1.0
    values = [(sample.hours, getattr(sample, field)) for sample in driver]
    return [(hours, value / scale) for hours, value in values if value is not None]
