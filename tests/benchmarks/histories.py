"""Histories of runs as text."""

from collections.abc import Callable

from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Merged,
    Noticed,
    Outcome,
    Part,
    Preparing,
    Record,
    RunEnded,
    ScoresSaved,
    Stored,
)
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import AGAIN, BEGAN, model, started

ZERO, ONE = TaskId.block(0), TaskId.block(1)
TASKS = {"0": ZERO, "1": ONE, "coarse": COARSE, "eval": EVAL, "shard": TaskId.shard(0)}
OF_RUN: dict[str, Record] = {
    "began": BEGAN,
    "again": AGAIN,
    "calibrating": Preparing("calibrating"),
    "preflight": Noticed(Part.PREFLIGHT, "it fits"),
    "starting": Preparing("starting workers"),
    "merged": Merged("point_cloud.ply", 10, 1, 100, 1.0),
    "done": RunEnded(Outcome.DONE),
}
OF_TASK: dict[str, Callable[[TaskId], Record]] = {
    "started": started,
    "saved": lambda task: CheckpointSaved(task, 10, "checkpoint", 1),
    "model": model,
    "scores": lambda task: ScoresSaved(task, "0.npz", 4),
}


def history(*timed: tuple[float, Record]) -> list[Stored]:
    return [Stored(number, time, record) for number, (time, record) in enumerate(timed, 1)]


def written(text: str) -> list[Stored]:
    """The history that says what happened after how many seconds: "0 began, 1 started coarse, 9 again"."""
    words = [part.split() for part in text.split(",")]
    return history(
        *((float(time), OF_TASK[what](TASKS[of[0]]) if of else OF_RUN[what]) for time, what, *of in words)
    )
