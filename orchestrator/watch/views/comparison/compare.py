"""The comparison of runs, as a pure function of what was read of them; `terminal` and pages show it."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

from panolog.orchestrator.runs.folder import flat, part_of
from panolog.orchestrator.runs.state import Status
from panolog.orchestrator.watch.views.block_colors import block_color
from panolog.orchestrator.watch.views.comparison.fairness import warnings
from panolog.orchestrator.watch.views.comparison.measured import Measured, finite, whole
from panolog.orchestrator.watch.views.comparison.reading import ReadRun, UnreadRun
from panolog.orchestrator.watch.views.comparison.schema import (
    LOWER_IS_BETTER,
    METRICS,
    ComparedRun,
    ComparedView,
    Comparison,
    DifferentSetting,
    MetricView,
    StageTime,
    Trained,
)
from panolog.orchestrator.watch.views.run_view import RunView, scene_name
from panolog.orchestrator.watch.views.summary import STAGES, TaskView
from panolog.scene.files import natural_key
from panolog.workers.tasks import Stage, TaskId

Picture = Callable[[ReadRun, str], str | None]  # where a run's picture of a held-out panorama is

_SETTINGS = 500  # that differ and are listed
_VIEWS = 2_000  # held-out panoramas that are listed
_LONG = 200  # characters of a setting or another text of run.json at most


def compare(
    runs: Sequence[ReadRun | UnreadRun],
    picture: Picture = lambda _, __: None,
    truth: Callable[[str], str | None] | None = None,
) -> Comparison:
    """Runs side by side, compared with the first one that could be read.

    Args: picture, of a run's held-out panorama, as `ComparedView`; truth, of a panorama's ground truth, by
    default the first of these pictures.
    """
    read = [run for run in runs if isinstance(run, ReadRun)]
    first = read[0] if read else None
    shown = [_shown(run, block_color(index), first) for index, run in enumerate(runs)]
    pairs = [(run, view) for run, view in zip(runs, shown, strict=True) if isinstance(run, ReadRun)]
    settings = list(_settings(runs))
    names = sorted({name for run in read if run.measured for name in run.measured.views}, key=natural_key)
    return Comparison(
        first=0 if first is None else runs.index(first),
        runs=tuple(shown),
        warnings=tuple(warnings(pairs)),
        settings=tuple(settings[:_SETTINGS]),
        more_settings=max(0, len(settings) - _SETTINGS),
        views=tuple(_view(name, runs, picture, truth) for name in names[:_VIEWS]),
        more_views=max(0, len(names) - _VIEWS),
    )


def _shown(run: ReadRun | UnreadRun, color: str, first: ReadRun | None) -> ComparedRun:
    if isinstance(run, UnreadRun):
        return ComparedRun(id=run.id, name=run.name, color=color, error=run.error)
    view, summary = run.view, run.view.summary
    settings = {setting.key: setting.value for setting in view.config}
    trained = [(TaskId.parse(task.name).stage, task) for task in summary.tasks]
    blocks = [task for stage, task in trained if stage is Stage.BLOCK]
    return ComparedRun(
        id=run.id,
        name=run.name,
        color=color,
        path=str(run.folder.root),
        status=summary.status,
        label=summary.label,
        stage=STAGES.get(summary.stage, ""),
        progress=finite(view.progress) or 0.0,
        scene=scene_name(view)[:_LONG] or None,
        fingerprint=_text(part_of(view.info, "scene"), "fingerprint"),
        version=_text(part_of(view.info, "versions"), "panolog"),
        recipe=_text(settings, "recipe"),
        width=whole(settings.get("width")),
        stage_one=_trained([task for stage, task in trained if stage.trains and not stage.refines]),
        blocks=len(summary.blocks) or None,
        blocks_done=sum(task.status == Status.DONE for task in blocks) if summary.blocks else None,
        stage_two=_trained([task for stage, task in trained if stage.refines]),
        gaussians=summary.kept_gaussians,
        bytes=summary.model.bytes if summary.model else None,
        seconds=finite(summary.seconds),
        stages=tuple(
            StageTime(name=stage.name, label=stage.label, seconds=finite(stage.seconds))
            for stage in view.stages
        ),
        memory=max((task.host_peak for task in summary.tasks if task.host_peak is not None), default=None),
        gpu_memory=_gpu_memory(view, settings),
        machines=_machines(view),
        measured=run.measured.head if run.measured else None,
        metrics=_metrics(run, first),
    )


def _text(values: Mapping[str, Any], key: str) -> str | None:
    """A value of run.json as text that is not too long; None if there is none."""
    return None if values.get(key) is None else str(values[key])[:_LONG]


def _trained(tasks: Sequence[TaskView]) -> Trained | None:
    """Iterations of tasks; None before the first has begun."""
    begun = [task for task in tasks if task.iteration is not None and task.iterations is not None]
    if not begun:
        return None
    return Trained(
        iteration=sum(task.iteration or 0 for task in begun),
        iterations=sum(task.iterations or 0 for task in begun),
    )


def _gpu_memory(view: RunView, settings: Mapping[str, Any]) -> int | None:
    """The peak of a task on its GPU, which its last progress has; None on a CPU."""
    if not str(settings.get("device")).startswith("cuda"):
        return None
    return max((task.memory for task in view.summary.tasks if task.memory is not None), default=None)


def _machines(view: RunView) -> tuple[str, ...]:
    """What the tasks ran on: hosts with their kinds of GPU, or their device."""
    names = (f"{node.node} ({', '.join(node.gpus) or node.device})" for node in view.nodes if node.device)
    return tuple(dict.fromkeys(names))


def _metrics(run: ReadRun, first: ReadRun | None) -> dict[str, MetricView]:
    if run.measured is None:
        return {}
    if first is None or first is run or first.measured is None:
        return {name: MetricView(mean=run.measured.mean[name]) for name in METRICS}
    return {name: _metric(name, run.measured, first.measured) for name in METRICS}


def _metric(name: str, measured: Measured, first: Measured) -> MetricView:
    """A metric compared with the first run's on the panoramas that both have."""
    pairs = [
        (value, other)
        for view, values in measured.views.items()
        if (value := values.get(name)) is not None
        and (other := first.views.get(view, {}).get(name)) is not None
    ]
    if not pairs:
        return MetricView(mean=measured.mean[name])
    difference = fmean(value for value, _ in pairs) - fmean(other for _, other in pairs)
    if measured.conditions != first.conditions:
        return MetricView(mean=measured.mean[name], difference=difference)
    sign = -1 if name in LOWER_IS_BETTER else 1
    return MetricView(
        mean=measured.mean[name],
        difference=difference,
        panoramas=len(pairs),
        better=sum(sign * value > sign * other for value, other in pairs),
        worse=sum(sign * value < sign * other for value, other in pairs),
    )


def _settings(runs: Sequence[ReadRun | UnreadRun]) -> Iterator[DifferentSetting]:
    """The settings that are not the same in all runs that could be read."""
    read = [run.view for run in runs if isinstance(run, ReadRun)]
    keys = {setting.key: setting.unit_or_doc for view in read for setting in view.config}
    values = [dict(flat(part_of(view.info, "config"))) for view in read]
    for key, doc in keys.items():
        known, found = [key in table for table in values], [table.get(key) for table in values]
        if len(set(known)) > 1 or any(value != found[0] for value in found):
            given = iter(zip(found, known, strict=True))
            cells = [next(given) if isinstance(run, ReadRun) else (None, False) for run in runs]
            yield DifferentSetting(
                key=key,
                values=tuple(_shortened(value) for value, _ in cells),
                known=tuple(there for _, there in cells),
                doc=doc,
            )


def _shortened(value: Any) -> Any:
    """A setting; a long one, or one with a number that JSON does not have, as text."""
    try:
        text = value if isinstance(value, str) else json.dumps(value, allow_nan=False)
    except ValueError:  # JSON has no such number
        return str(value)[:_LONG]
    return value if len(text) <= _LONG else f"{text[:_LONG]} …"


def _view(
    name: str,
    runs: Sequence[ReadRun | UnreadRun],
    picture: Picture,
    truth: Callable[[str], str | None] | None,
) -> ComparedView:
    """A held-out panorama in all runs."""
    measured = [run.measured if isinstance(run, ReadRun) else None for run in runs]
    values = [found.views.get(name) if found else None for found in measured]
    pictures = [
        picture(run, name) if isinstance(run, ReadRun) and there is not None else None
        for run, there in zip(runs, values, strict=True)
    ]
    return ComparedView(
        name=name,
        metrics=tuple(None if there is None else dict(there) for there in values),
        pictures=tuple(pictures),
        truth=truth(name) if truth else next(filter(None, pictures), None),
    )
