"""Where a run stands, as a pure function of its records: `replay(records) -> RunState`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from typing_extensions import assert_never

from panolog.orchestrator.run.records import (
    BlockPlan,
    CheckpointSaved,
    EvaluationSaved,
    Failure,
    Merged,
    ModelSaved,
    Noticed,
    Outcome,
    PauseRequested,
    PlanSaved,
    PreviewSaved,
    Progressed,
    Record,
    RetryRequested,
    RunBegan,
    RunEnded,
    ScoresSaved,
    StopRequested,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
    Transferred,
    UnpauseRequested,
    ViewEvaluated,
)
from panolog.workers.tasks import EVAL, MERGE, StrEnum, TaskId


class Status(StrEnum):
    """How a task stands."""

    WAITING = "waiting"
    PAUSED = "paused"  # waiting until the user unpauses it
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True)
class TaskState:
    """One task."""

    id: TaskId
    status: Status = Status.WAITING
    attempts: int = 0  # by the present driver
    retries: int = 0  # attempts that failed and were repeated, by any driver
    reasons: tuple[str, ...] = ()  # why attempts failed
    checkpoint: int | None = None  # iteration of the last one on disk
    node: str = ""
    progress: Progressed | None = None  # the latest
    seconds: float | None = None  # of training, of the attempt that ended it
    iterations: int | None = None  # of which it has all
    gaussians: int | None = None  # of its model
    begun: int = 0  # iteration from which its latest attempt continues
    since: float | None = None  # seconds since the epoch: its latest attempt
    place: str = ""  # kind of place of its latest attempt
    errors: int = 0  # attempts that failed through it, in a row without a checkpoint, with this driver
    losses: int = 0  # attempts that were lost through no fault of it, in a row likewise
    shortages: int = 0  # attempts that ran out of memory, with this driver
    starved: int = 0  # bytes of memory that the last of these had
    received: int = 0  # bytes that other machines have sent to its attempts
    sent: int = 0  # bytes that its attempts have sent to other machines
    held: bool = False  # a user has requested a pause; it may still run, towards a last checkpoint

    @property
    def at_rest(self) -> Status:
        """Its status when it neither runs nor is over."""
        return Status.PAUSED if self.held else Status.WAITING


@dataclass(frozen=True)
class RunState:
    """The whole run."""

    tasks: dict[TaskId, TaskState] = field(default_factory=dict)
    plan: tuple[BlockPlan, ...] | None = None
    notices: tuple[Noticed, ...] = ()
    merged: Merged | None = None
    metrics: dict[str, float | None] | None = None
    outcome: Outcome | None = None  # of the last driver; None if it is at work or was killed
    reason: str = ""
    began: float | None = None  # seconds since the epoch: the first driver
    ended: float | None = None
    latest: float | None = None  # the last record

    def task(self, id: TaskId) -> TaskState:
        """A task, waiting if nothing has happened to it yet."""
        return self.tasks.get(id) or TaskState(id)

    def status(self, id: TaskId) -> Status:
        """How a task stands."""
        return self.task(id).status

    def failed_blocks(self) -> tuple[int, ...]:
        """Blocks that have used up their attempts, and so keep their Stage I Gaussians."""
        return tuple(b.block for b in self.plan or () if self.status(TaskId.block(b.block)) == Status.FAILED)

    def held_blocks(self) -> tuple[int, ...]:
        """Blocks that the user has paused."""
        return tuple(b.block for b in self.plan or () if self.task(TaskId.block(b.block)).held)


OnChange = Callable[[RunState, Sequence[Stored]], None]  # called with each change of state and what is new


def ignore(*_: object) -> None:
    """A callback that does nothing."""


def replay(records: Iterable[Stored]) -> RunState:
    """The state after those records, in order."""
    state, latest = RunState(), None
    for stored in records:
        state, latest = _apply(state, stored), stored.time
    return replace(state, latest=latest)


def apply(state: RunState, stored: Stored) -> RunState:
    """The state after one more record. Previews and single views change nothing."""
    return _apply(replace(state, tasks=dict(state.tasks), latest=stored.time), stored)


def _apply(state: RunState, stored: Stored) -> RunState:
    """The same but for `latest`, in place where it is about tasks: copies would take most of a replay."""
    record = stored.record
    match record:
        case RunBegan():
            state = _take_over(state, stored.time)
        case RunEnded():
            state = replace(state, outcome=record.outcome, reason=record.reason, ended=stored.time)
        case Noticed() if record not in state.notices:  # a task that is taken up again repeats its notices
            state = replace(state, notices=(*state.notices, record))
        case PlanSaved():
            state = replace(state, plan=record.blocks)
        case ModelSaved():
            state = _outdate_merge(state)
        case Merged():
            state = replace(state, merged=record)
        case EvaluationSaved():
            state = replace(state, metrics=record.metrics)
    if isinstance(record.task, TaskId):
        task = state.task(record.task)
        changes = _changes(task, record)
        if isinstance(record, TaskStarted):
            changes["since"] = stored.time
        if changes:
            state.tasks[task.id] = replace(task, **changes)
    return state


def _changes(task: TaskState, record: Record) -> dict[str, Any]:
    """What a record changes in its own task."""
    changes: dict[str, Any] = {}
    match record:
        case TaskStarted():
            changes = {
                "status": Status.RUNNING,
                "attempts": record.attempt,
                "node": record.node,
                "begun": record.iteration,
                "place": record.place,
            }
        case Progressed():
            changes = {"progress": record}
        case CheckpointSaved():
            changes = {"checkpoint": record.iteration, "errors": 0, "losses": 0}
        case ModelSaved():
            changes = {
                "status": Status.DONE,
                "seconds": record.seconds,
                "iterations": record.iterations,
                "gaussians": record.gaussians,
                "held": False,
            }
        case Merged():
            changes = {"status": Status.DONE, "seconds": record.seconds}
        case Transferred():
            changes = {"received": task.received + record.received, "sent": task.sent + record.sent}
        case ScoresSaved() | PlanSaved() | EvaluationSaved():
            changes = {"status": Status.DONE}
        case TaskFailed():
            changes = _failure(task, record)
        case TaskYielded():
            changes = {"status": task.at_rest}
        case PauseRequested() | UnpauseRequested() | RetryRequested():
            changes = _request(task, record)
        case RunBegan() | StopRequested() | RunEnded() | Noticed() | PreviewSaved() | ViewEvaluated():
            pass
        case _:
            assert_never(record)
    return changes


def _failure(task: TaskState, record: TaskFailed) -> dict[str, Any]:
    changes: dict[str, Any] = {
        "status": Status.FAILED if record.final else task.at_rest,
        "attempts": record.attempt,
        "retries": task.retries + (not record.final),
        "reasons": (*task.reasons, f"{record.reason}; {record.then}" if record.then else record.reason),
    }
    if record.kind == Failure.LOST:
        return changes | {"losses": task.losses + 1}
    if record.kind == Failure.MEMORY:
        changes |= {"shortages": task.shortages + 1, "starved": record.memory}
    return changes | {"errors": task.errors + 1}


# A new driver may have other machines: earlier failures do not count.
_FRESH: dict[str, Any] = {"attempts": 0, "errors": 0, "losses": 0, "shortages": 0, "starved": 0}


def _request(task: TaskState, record: PauseRequested | UnpauseRequested | RetryRequested) -> dict[str, Any]:
    """The user's request about a task. One that runs continues until it yields."""
    changes: dict[str, Any] = dict(_FRESH)
    if not isinstance(record, RetryRequested):
        changes = {"held": isinstance(record, PauseRequested)}
    if task.status != Status.RUNNING:
        changes["status"] = replace(task, **changes).at_rest
    return changes


def _take_over(state: RunState, time: float) -> RunState:
    """Whatever another driver had running is waiting again, and what had failed gets new attempts."""
    tasks = {
        name: task if task.status == Status.DONE else replace(task, status=task.at_rest, **_FRESH)
        for name, task in state.tasks.items()
    }
    began = time if state.began is None else state.began
    return replace(state, tasks=tasks, outcome=None, reason="", began=began, ended=None)


def _outdate_merge(state: RunState) -> RunState:
    """A new model makes a merge of older ones, and its metrics, worthless."""
    if state.tasks.keys().isdisjoint((MERGE, EVAL)):
        return state
    tasks = {id: task for id, task in state.tasks.items() if id not in (MERGE, EVAL)}
    return replace(state, tasks=tasks, merged=None, metrics=None)
