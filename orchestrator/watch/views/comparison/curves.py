"""The curves of a run on one axis: its stages one after the other, by iteration and by minutes.

The tasks of a stage train side by side or one after the other. Their loss and PSNR are averaged, and their
Gaussians are summed; before a task begins it has none, and after its end those it ended with.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.comparison.reading import DAMAGED, ReadRun, UnreadRun
from panolog.orchestrator.watch.views.comparison.schema import (
    Curve,
    CurvesOfRuns,
    Line,
    RunCurves,
    StageCurves,
)
from panolog.orchestrator.watch.views.queries import series, spread
from panolog.orchestrator.watch.views.summary import STAGES, TaskView
from panolog.scene.errors import InputError
from panolog.workers.tasks import Stage, TaskId

NAMES = ("loss", "psnr", "gaussians")
_SUMMED = "gaussians"
_POINTS = 240  # of a curve
_TASKS = 16  # of a stage that are read
_DIGITS = 6  # significant ones of a value

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Points:
    """A curve of a task: (P,) arrays, iterations and minutes not decreasing."""

    iterations: Floats
    minutes: Floats
    values: Floats


def curves_of(runs: Sequence[ReadRun | UnreadRun]) -> CurvesOfRuns:
    """The curves of runs, of at most _POINTS points; of a database that cannot be read the error."""
    return CurvesOfRuns(runs=tuple(map(_of_run, runs)))


def _of_run(run: ReadRun | UnreadRun) -> RunCurves:
    if isinstance(run, UnreadRun):
        return RunCurves(id=run.id, stages=(), error=run.error)
    try:
        return RunCurves(id=run.id, stages=tuple(_stages(run)))
    except InputError as error:
        return RunCurves(id=run.id, stages=(), error=str(error))
    except DAMAGED as error:
        return RunCurves(id=run.id, stages=(), error=f"{type(error).__name__}: {error}")


def _stages(run: ReadRun) -> list[StageCurves]:
    begun = [task for task in run.view.summary.tasks if task.iteration is not None]
    offset, stages = 0, []
    for stage in Stage:
        tasks = [task for task in begun if TaskId.parse(task.name).stage is stage]
        if stage.trains and tasks:
            stages.append(_stage(run, stage, tasks, offset))
            offset += max(task.iterations or task.iteration or 0 for task in tasks)
    return stages


def _stage(run: ReadRun, stage: Stage, tasks: Sequence[TaskView], offset: int) -> StageCurves:
    """Args: tasks, those that have begun; offset, iterations of the stages before."""
    read = spread(tasks, _TASKS)
    found = [series(run.folder.database, task.name, _POINTS, NAMES) for task in read]
    curves = {}
    for name in NAMES:
        points = [_points(run, one[name]) for one in found if name in one]
        if points := [one for one in points if len(one.values)]:
            weight = len(tasks) / len(read) if name == _SUMMED else None
            curves[name] = Curve(
                iterations=_line(points, lambda one: one.iterations, weight, offset=offset, together=True),
                minutes=_line(points, lambda one: one.minutes, weight),
            )
    return StageCurves(stage=stage, label=STAGES[stage], tasks=len(tasks), read=len(read), curves=curves)


def _points(run: ReadRun, given: dict[str, list[Any]]) -> _Points:
    """A series without what is no number, which only a damaged run can hold."""
    state, rows = run.state, zip(given["iteration"], given["time"], given["value"], strict=True)
    numbers = [row for row in rows if all(isinstance(value, int | float) for value in row)]
    began = state.began if state.began is not None else min((time for _, time, _ in numbers), default=0.0)
    found = [(step, state.worked(began, time) / 60, value) for step, time, value in numbers]
    sound = np.array([row for row in found if all(map(math.isfinite, row))], np.float64).reshape(-1, 3)
    minutes = np.maximum.accumulate(sound[:, 1])  # a clock may have been set back
    return _Points(sound[:, 0], minutes, sound[:, 2])


def _line(
    points: Sequence[_Points],
    axis: Callable[[_Points], Floats],
    weight: float | None,
    *,
    offset: int = 0,
    together: bool = False,
) -> Line:
    """The mean of curves, or with `weight` their sum times that, at points evenly spaced on an axis.

    Args: offset, added to the axis; together, whether all have begun where the first one has.
    """
    if len(points) == 1:
        x, y = axis(points[0]), points[0].values * (weight or 1.0)
        return _rounded(x + offset, y)
    begin, end = min(axis(one)[0] for one in points), max(axis(one)[-1] for one in points)
    x = np.linspace(begin, end, _POINTS)
    total, count = np.zeros(len(x)), np.zeros(len(x))
    for one in points:
        own = axis(one)
        summed = weight is not None
        inside = ((x >= own[0]) | (summed and together)) & ((x <= own[-1]) | summed)
        total += np.where(inside, np.interp(x, own, one.values), 0.0)
        count += inside
    y = total * weight if weight is not None else total / np.maximum(count, 1)
    return _rounded(x + offset, np.where(count > 0, y, np.nan))


def _rounded(x: Floats, y: Floats) -> Line:
    values = [None if math.isnan(value) else float(f"{value:.{_DIGITS}g}") for value in y.tolist()]
    return Line(x=tuple(round(value, 4) for value in x.tolist()), y=tuple(values))
