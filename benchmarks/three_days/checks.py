"""Whether anything was lost, doubled or recorded out of order in a simulated run."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from benchmarks.three_days.faults import Period
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

LAST_S = (
    60.0  # seconds before a kill of the driver whose messages may be unrecorded: the tasks send them again
)
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
    """What was lost, doubled, or recorded out of order, one line each."""
    kills = [Period(life.end - LAST_S, life.end + 1) for life in lives if life.killed]
    by_task: dict[TaskId, list[Sent]] = {}
    for line in sent:
        if line.kind in _KINDS:
            by_task.setdefault(line.task, []).append(line)
    recorded: dict[TaskId, list[Record]] = {}
    for stored in records:
        if isinstance(stored.record, tuple(_KINDS.values())) and isinstance(stored.record.task, TaskId):
            recorded.setdefault(stored.record.task, []).append(stored.record)
    for task in by_task.keys() | recorded.keys():
        yield from _wrong_of(task, by_task.get(task, []), recorded.get(task, []), kills)
    # The last progress of a task is stored with its result, under its own time.
    others = [stored for stored in records if not isinstance(stored.record, Progressed)]
    if any(a.time > b.time for a, b in pairwise(others)):
        yield "records are not in the order of time"


def _wrong_of(
    task: TaskId, sent: Sequence[Sent], records: Sequence[Record], kills: Sequence[Period]
) -> Iterator[str]:
    """The same of one task: both are read side by side."""
    left = list(reversed(records))
    for line in sent:
        kind = _KINDS[line.kind]
        if left and type(left[-1]) is kind and _iteration(left[-1], line.value) == line.value:
            left.pop()
        elif kind not in _THINNED and not any(period.has(line.time) for period in kills):
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
