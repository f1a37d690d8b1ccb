"""Whether anything was lost, doubled or recorded out of order in a simulated run."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from benchmarks.three_days.life import Paths
from benchmarks.three_days.load import HOUR, Load
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    ModelSaved,
    PreviewSaved,
    Progressed,
    Record,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.run.state import RunState, Status
from panolog.scene.files import SUFFIX
from panolog.scene.ply import ply_header
from panolog.workers.tasks import TaskId

# The record that follows each message of a worker.
_KINDS: dict[str, type[object]] = {
    "Hello": TaskStarted,
    "Checkpoint": CheckpointSaved,
    "Preview": PreviewSaved,
    "Trained": ModelSaved,
    "Scored": ScoresSaved,
    "Failed": TaskFailed,
    "cancelled": TaskFailed,
}
_THINNED = (PreviewSaved,)  # the driver keeps some of them


@dataclass(frozen=True)
class Life:
    """One driver: seconds since the start of the run."""

    begin: float
    end: float
    killed: bool  # or else stopped, or at the end of the run


@dataclass(frozen=True)
class Sent:
    """What a simulated worker has delivered, or what has become of it; a line of the log."""

    time: float  # seconds since the start of the run
    task: TaskId
    kind: str
    value: int  # iteration
    detail: str


def read_sent(paths: Paths) -> list[Sent]:
    """The log of the workers."""
    lines = (line.split("\t", 4) for line in paths.log.read_text().splitlines())
    return [
        Sent(float(t), TaskId.parse(task), kind, int(v), "".join(rest)) for t, task, kind, v, *rest in lines
    ]


def wrong(sent: Sequence[Sent], records: Sequence[Stored], lives: Sequence[Life]) -> Iterator[str]:
    """What was lost, doubled, or recorded out of order, one line each.

    Args: records, of the whole run; the first is that of the first driver's start.
    """
    epoch, begins = records[0].time - lives[0].begin, [life.begin for life in lives]
    attempts: dict[tuple[TaskId, int], tuple[list[Sent], list[Record]]] = {}
    for line in sent:
        if line.kind in _KINDS:
            number = bisect_right(begins, line.time) - 1
            attempts.setdefault((line.task, number), ([], []))[0].append(line)
    for stored in records:
        if isinstance(stored.record, tuple(_KINDS.values())) and isinstance(stored.record.task, TaskId):
            number = bisect_right(begins, stored.time - epoch) - 1
            attempts.setdefault((stored.record.task, number), ([], []))[1].append(stored.record)
    for (task, number), (lines, recorded) in attempts.items():
        yield from _wrong_of(task, lines, recorded, lives[number])
    # The last progress of a task is stored with its result, under its own time.
    others = [stored for stored in records if not isinstance(stored.record, Progressed)]
    if any(a.time > b.time for a, b in pairwise(others)):
        yield "records are not in the order of time"


def _wrong_of(task: TaskId, sent: Sequence[Sent], records: Sequence[Record], life: Life) -> Iterator[str]:
    """What is wrong with the records of one task under one driver; messages and records are read in step.

    A driver records what it has taken before the simulated clock goes on. So a kill can lose the messages of
    the last moment alone, and nothing of the task is recorded after them; its next attempt sends them again.
    """
    left = list(reversed(records))
    for line in sent:
        kind = _KINDS[line.kind]
        if left and type(left[-1]) is kind and _iteration(left[-1], line.value) == line.value:
            left.pop()
        elif kind not in _THINNED and (left or not life.killed or line.time < life.end):
            yield f"{task}: {line.kind} {line.value} of {line.time / HOUR:.3f} h is not recorded"
    for record in left:
        yield f"{task}: {type(record).__name__} is recorded, but was not sent: {record}"


def _iteration(record: Record, other: int) -> int:
    """Of a record whose message names one, else `other`."""
    return record.iteration if isinstance(record, CheckpointSaved | PreviewSaved) else other


def incomplete(paths: Paths, load: Load, state: RunState, records: Sequence[Stored]) -> Iterator[str]:
    """Blocks without exactly one model, files without a record, a merged model of another size."""
    models = Counter(item.record.task for item in records if isinstance(item.record, ModelSaved))
    for block in range(load.blocks):
        task = TaskId.block(block)
        if state.status(task) != Status.DONE or models[task] != 1:
            yield f"{task}: is {state.status(task)} with {models[task]} models"
        if paths.run.checkpoint(task).exists():
            yield f"{task}: its checkpoint is still there"
    if state.merged is None or ply_header(paths.run.point_cloud)[0] != sum(load.gaussians):
        yield f"the merged model has not the {sum(load.gaussians)} Gaussians of all blocks"
    yield from (f"{path} is left" for path in paths.run.root.rglob(f"*{SUFFIX}"))
