"""A comparison of runs on the terminal: a table with a column for each run."""

from collections.abc import Callable, Iterator

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from panolog.orchestrator.runs.units import duration, gib
from panolog.orchestrator.watch.views.comparison.schema import (
    LOWER_IS_BETTER,
    METRICS,
    ComparedRun,
    Comparison,
    MetricView,
    Trained,
)
from panolog.orchestrator.watch.views.summary import METRICS as LABELS
from panolog.orchestrator.watch.views.summary import STAGES, metric_text

_NONE = "–"
_UNFAIR = "not fair: "
_GOOD, _BAD = "green", "red"
_COLOURS = {"running": "cyan", "done": "green", "failed": "red", "interrupted": "yellow", "stopped": "yellow"}
_SETTINGS = 40  # that are listed; the page and --json have more
_DIFFERENT = ("PanoLOG",)  # facts that are of interest only where they differ
_FACTS = ("recipe", "width")  # settings that are among the facts
_NAME, _COLUMN = 24, 26  # columns of the terminal: the names of rows, and a run


def width_of(comparison: Comparison) -> int:
    """Columns of a terminal in which no line is broken, unless a name or a setting is long."""
    longest = max((len(line) for line in comparison.warnings), default=0)
    return max(_NAME + _COLUMN * len(comparison.runs), len(_UNFAIR) + longest)


def table(comparison: Comparison) -> RenderableType:
    """The comparison for a terminal: the runs, their metrics, settings that differ, and what is not fair."""
    rows = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold", show_edge=False)
    rows.add_column("", style="dim", no_wrap=True)
    for run in comparison.runs:
        rows.add_column(Text(_plain(run.name)), overflow="fold")
    for label, cells in (*_facts(comparison), *_minutes(comparison), *_metrics(comparison)):
        rows.add_row(label, *(Text(cell) if isinstance(cell, str) else cell for cell in cells))
    if comparison.settings:
        rows.add_row("")
    settings = [setting for setting in comparison.settings if setting.key not in _FACTS]
    for setting in settings[:_SETTINGS]:
        cells = [
            Text(_plain(_value(value)) if known else _NONE)
            for value, known in zip(setting.values, setting.known, strict=True)
        ]
        rows.add_row(Text(_plain(setting.key)), *cells)
    lines = [Text(f"{_UNFAIR}{_plain(line)}", style="yellow") for line in comparison.warnings]
    more = len(settings[_SETTINGS:]) + comparison.more_settings
    if more:
        lines.append(Text(f"{more:,} more settings differ: see -o FILE.html or --json", style="dim"))
    return Group(rows, *([Text("")] if lines else []), *lines)


def _plain(text: str) -> str:
    """A text of others without what a terminal would take as a command."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)


Row = tuple[str, list[RenderableType]]


def _facts(comparison: Comparison) -> Iterator[Row]:
    """What the runs are and have come to; rows that no run has are left out."""
    getters: dict[str, Callable[[ComparedRun], RenderableType | None]] = {
        "state": _state,
        "recipe": lambda run: run.recipe and _plain(run.recipe),
        "scene": lambda run: run.scene and _plain(run.scene),
        "PanoLOG": lambda run: run.version and _plain(run.version),
        "width": lambda run: f"{run.width:,}" if run.width is not None else None,
        "iterations of Stage I": lambda run: _iterations(run.stage_one),
        "blocks": _blocks,
        "iterations of Stage II": lambda run: _iterations(run.stage_two),
        "Gaussians": lambda run: f"{run.gaussians:,}" if run.gaussians is not None else None,
        "bytes": lambda run: f"{run.bytes:,}" if run.bytes is not None else None,
        "peak memory": lambda run: gib(run.memory) if run.memory is not None else None,
        "peak GPU memory": lambda run: gib(run.gpu_memory) if run.gpu_memory is not None else None,
        "machines": lambda run: _plain(", ".join(run.machines)) or None,
    }
    for label, get in getters.items():
        cells = [get(run) for run in comparison.runs]
        if any(cells) and (label not in _DIFFERENT or len(set(map(str, cells))) > 1):
            yield label, [cell or _NONE for cell in cells]


def _state(run: ComparedRun) -> Text:
    text = Text(run.label, style=_COLOURS.get(run.status, ""))
    if run.status != "done":
        text.append(
            f" · {run.stage} · {int(100 * run.progress)}%" if run.stage else f" · {int(100 * run.progress)}%"
        )
    return text


def _iterations(trained: Trained | None) -> str | None:
    if trained is None:
        return None
    done, whole = f"{trained.iteration:,}", f"{trained.iterations:,}"
    return whole if trained.iteration >= trained.iterations else f"{done} of {whole}"


def _blocks(run: ComparedRun) -> str | None:
    if run.blocks is None:
        return None
    return f"{run.blocks:,}" if run.status == "done" else f"{run.blocks:,}, {run.blocks_done or 0:,} done"


def _minutes(comparison: Comparison) -> Iterator[Row]:
    """The time of the runs and of their stages."""
    yield "time", [duration(run.seconds) if run.seconds is not None else _NONE for run in comparison.runs]
    seconds = [{stage.name: stage.seconds for stage in run.stages} for run in comparison.runs]
    for name, label in _stages(comparison).items():
        found = [table.get(name) for table in seconds]
        if any(value is not None for value in found):
            yield f"  {label}", [duration(value) if value is not None else _NONE for value in found]


def _stages(comparison: Comparison) -> dict[str, str]:
    """The stages that some run has, in their order, with their labels."""
    labels = {stage.name: stage.label for run in comparison.runs for stage in run.stages}
    return {name: labels[name] for name in STAGES if name in labels}


def _metrics(comparison: Comparison) -> Iterator[Row]:
    """The means over the held-out panoramas, with the difference to the first run."""
    for name in METRICS:
        found = [run.metrics.get(name) for run in comparison.runs]
        if any(metric is not None and metric.mean is not None for metric in found):
            unit = ", dB" if "psnr" in name else ", less is better" if name in LOWER_IS_BETTER else ""
            yield f"{LABELS[name]}{unit}", [_mean(metric, name) for metric in found]
            if any(metric is not None and metric.panoramas for metric in found):
                yield "  better, worse in", [_better(metric) for metric in found]


def _mean(metric: MetricView | None, name: str) -> RenderableType:
    if metric is None or metric.mean is None:
        return _NONE
    text = Text(metric_text(metric.mean, name))
    if metric.difference is not None:
        sign = -1 if name in LOWER_IS_BETTER else 1
        style = _GOOD if sign * metric.difference > 0 else _BAD if metric.difference else ""
        symbol = "−" if metric.difference < 0 else "+"
        text.append(f"  {symbol}{metric_text(abs(metric.difference), name)}", style=style)
    return text


def _better(metric: MetricView | None) -> str:
    """In how many panoramas a run is better and worse than the first."""
    if metric is None or not metric.panoramas:
        return ""
    return f"{metric.better:,}, {metric.worse:,} of {metric.panoramas:,}"


def _value(value: object) -> str:
    """A setting as a terminal shows it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
