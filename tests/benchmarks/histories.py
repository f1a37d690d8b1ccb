"""Histories of runs made by hand."""

from panolog.orchestrator.run.records import ModelSaved, Record, Stored, TaskStarted
from panolog.workers.tasks import TaskId


def started(task: TaskId, attempt: int = 1) -> TaskStarted:
    return TaskStarted(task, attempt, 0, "node", 1, "cpu", 1)


def model(task: TaskId) -> ModelSaved:
    return ModelSaved(task, "model.ply", 10, 100, 30, 1.0)


def history(*timed: tuple[float, Record]) -> list[Stored]:
    return [Stored(number, time, record) for number, (time, record) in enumerate(timed, 1)]
