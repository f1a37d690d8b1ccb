"""Where a run stands, as a pure function of its records: `replay(records) -> RunState`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from typing_extensions import assert_never

from panolog.orchestrator.runs.machines import history as machines
from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.money.spending import Spending, spend
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    Delivered,
    EvaluationSaved,
    Failure,
    MeasuresSaved,
    Merged,
    ModelSaved,
    NodeLeaving,
    NodeQuarantined,
    Noticed,
    OfAttempt,
    Outcome,
    Part,
    PauseRequested,
    PlanSaved,
    PreflightSaved,
    Preparing,
    PreviewSaved,
    Progressed,
    Record,
    Request,
    Result,
    RetryRequested,
    RunBegan,
    RunContinued,
    RunEnded,
    RunWaiting,
    ScoresSaved,
    StopRequested,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
    Transferred,
    UnpauseRequested,
)
from panolog.workers.tasks import DELIVER, EVAL, MERGE, Stage, StrEnum, TaskId


class Status(StrEnum):
    """How a task stands."""

    WAITING = "waiting"
    PAUSED = "paused"  # waiting until the user unpauses it
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True)
class TaskState:
    id: TaskId
    status: Status = Status.WAITING
    attempts: int = 0  # by the present driver
    retries: int = 0  # attempts that failed and were repeated, by any driver
    reasons: tuple[str, ...] = ()  # why attempts failed
    checkpoint: int | None = None  # iteration of the last one on disk
    saved: float | None = None  # seconds since the epoch: when that was
    node: str = ""  # host of its latest attempt
    where: tuple[str, str] = ("", "")  # Node.id and Node.card of the same
    progress: Progressed | None = None  # the latest
    seconds: float | None = None  # of the attempt that ended it
    spent: float = 0.0  # seconds of the attempts before
    iterations: int | None = None  # of which it has all
    gaussians: int | None = None  # of its model
    begun: int = 0  # iteration from which its latest attempt continues
    since: float | None = None  # seconds since the epoch: the start of its latest attempt
    place: str = ""  # kind of place of its latest attempt
    errors: int = 0  # attempts that failed through it, in a row without a checkpoint, with this driver
    losses: int = 0  # attempts that were lost through no fault of it, in a row likewise
    preemptions: int = 0  # attempts that were lost with a node that had announced it, in a row likewise
    moves: int = 0  # attempts that have ended with a checkpoint because their node left
    failures: tuple[machines.Misfortune, ...] = ()  # of both, shortages of memory aside
    shortages: int = 0  # attempts that ran out of memory, with this driver
    starved: int = 0  # bytes of memory that the last of these had
    received: int = 0  # bytes that other machines have sent to its attempts
    sent: int = 0  # bytes that its attempts have sent to other machines
    held: bool = False  # a user has requested a pause; it may still run, towards a last checkpoint

    @property
    def at_rest(self) -> Status:
        """The status of a task that neither runs nor is over."""
        return Status.PAUSED if self.held else Status.WAITING


@dataclass(frozen=True)
class RunState:
    """The whole run."""

    tasks: dict[TaskId, TaskState] = field(default_factory=dict)
    plan: tuple[BlockPlan, ...] | None = None
    blocks: tuple[TaskId, ...] = ()  # those to train, longest first
    passes: tuple[tuple[TaskId, ...], ...] = ()  # tasks that train parts of the blocks' union once more
    measures: tuple[TaskId, ...] = ()  # shards of the evaluation; none = it is one task
    notices: dict[Noticed, None] = field(default_factory=dict)  # a set in the order of time
    merged: Merged | None = None
    metrics: dict[str, float | None] | None = None
    outcome: Outcome | None = None  # of the last driver; None if it is at work or was killed
    reason: str = ""
    transient: bool = False  # another driver may succeed where the last one failed
    began: float | None = None  # seconds since the epoch: the first driver
    ended: float | None = None
    latest: float | None = None  # the last record
    driver: RunBegan | None = None  # the last
    away: tuple[tuple[float, float], ...] = ()  # when no driver was at work on it, between two
    step: str = ""  # what the driver does before its first task
    preparing: bool = False  # whether that is a part of making the scene
    waiting: str = ""  # why the run waits for its disk or a machine; "" if it does not
    estimate: dict[str, float | None] | None = None  # `PreflightSaved.seconds`
    nodes: machines.Nodes = field(default_factory=dict)
    money: Spending = field(default_factory=Spending)

    @property
    def prepared(self) -> bool:
        """Whether its preflight is over."""
        older = any(notice.task is Part.PREFLIGHT for notice in self.notices)
        return older or self.estimate is not None or bool(self.tasks)

    def worked(self, begin: float, end: float) -> float:
        """Seconds between two times in which a driver was at work."""
        return end - begin - sum(max(0.0, min(end, b) - max(begin, a)) for a, b in self.away)

    def task(self, id: TaskId) -> TaskState:
        """A task, waiting if nothing has happened to it yet."""
        return self.tasks.get(id) or TaskState(id)

    def status(self, id: TaskId) -> Status:
        """How a task stands."""
        return known.status if (known := self.tasks.get(id)) else Status.WAITING

    def failed_blocks(self) -> tuple[int, ...]:
        """Blocks that have used up their attempts, and so keep their Stage I Gaussians."""
        return tuple(b.block for b in self.plan or () if self.status(TaskId.block(b.block)) == Status.FAILED)

    def quarantined(self) -> tuple[machines.NodeState, ...]:
        """The nodes in quarantine, by host."""
        return machines.by_host(node for node in self.nodes.values() if node.until is not None)

    def leaving(self) -> tuple[machines.NodeState, ...]:
        """The nodes that have announced that they leave, by host, until they have left."""
        return machines.by_host(node for node in self.nodes.values() if node.leave and not node.leave.over)

    @property
    def between(self) -> tuple[tuple[TaskId, ...], ...]:
        """The stages between the blocks and the merge: unions, each with a pass over it."""
        return tuple(stage for i, tasks in enumerate(self.passes) for stage in ((TaskId.union(i),), tasks))

    def following(self, id: TaskId) -> tuple[tuple[TaskId, ...], ...]:
        """The stages from the blocks to the merge that make something of a task's model."""
        stages = self.between  # of a pass, which has thousands of tasks, one is found by its kind
        has = [id in stage[:1] or (len(stage) > 1 and stage[0].stage is id.stage) for stage in stages]
        return (*stages[has.index(True) + 1 if True in has else 0 :], (MERGE,))

    def joined(self, id: TaskId) -> bool:
        """Whether a task's model, or what stands for it, is already a part of another."""
        return self.status(self.following(id)[0][0]) == Status.DONE

    def held_blocks(self) -> tuple[int, ...]:
        """Blocks that the user has paused."""
        return tuple(b.block for b in self.plan or () if self.task(TaskId.block(b.block)).held)


OfTask = OfAttempt | Result | Request
OnChange = Callable[[RunState, Sequence[Stored]], None]  # called with each change of state and what is new


def ignore(*_: object) -> None:
    """A callback that does nothing."""


def replay(records: Iterable[Stored]) -> RunState:
    """The state after those records, in order."""
    return apply(RunState(), records)


def apply(state: RunState, records: Iterable[Stored]) -> RunState:
    """The state after some more records, in order. Previews and single views change nothing."""
    latest = state.latest
    money = replace(state.money, machines=dict(state.money.machines), running=dict(state.money.running))
    state = replace(state, tasks=dict(state.tasks), notices=dict(state.notices), money=money)
    for stored in records:
        state, latest = _apply(state, stored), stored.time
    return replace(state, latest=latest)


def at_rest(state: RunState) -> RunState:
    """The state without a driver: what was running waits, and time has ended with the last record."""
    end = state.ended or state.latest
    tasks = {name: _interrupted(task, end) for name, task in state.tasks.items()}
    return replace(state, tasks=tasks, step="", waiting="", ended=end)


def _apply(state: RunState, stored: Stored) -> RunState:
    """Applies one record but for `latest`. Tasks, notices and costs change in place: copies take too long."""
    match record := stored.record:
        case RunBegan():
            state = _take_over(state, record, stored.time)
        case Preparing():
            state = replace(state, step=record.step, preparing=record.task.stage is Stage.PREPARE)
        case PreflightSaved():
            state = replace(state, step="", estimate=record.seconds)
        case RunWaiting() | RunContinued():
            state = replace(state, waiting=record.reason if isinstance(record, RunWaiting) else "")
        case RunEnded():
            state = replace(state, outcome=record.outcome, reason=record.reason, waiting="")
            state = replace(state, transient=record.transient, ended=stored.time)
        case Noticed():
            state.notices[record] = None  # a task that is taken up again repeats its notices
        case PlanSaved():
            passes = tuple(tuple(map(TaskId.parse, tasks)) for tasks in record.passes)
            measures = tuple(map(TaskId.measure, range(record.measures)))
            order = sorted((-b.gaussians, -b.cameras, b.block) for b in record.blocks if b.train)
            blocks = tuple(TaskId.block(block) for *_, block in order)
            state = replace(state, plan=record.blocks, blocks=blocks, passes=passes, measures=measures)
        case ModelSaved():
            state = _outdate(state, record.task)
        case Merged():
            state = replace(state, merged=record)
        case EvaluationSaved():
            state = replace(state, metrics=record.metrics)
    state = _with_money(_with_nodes(state, record, stored.time), stored)
    if isinstance(record, OfTask) and record.task is not None:
        task = state.task(record.task)
        if changes := _changes(task, record, stored.time):
            state.tasks[task.id] = changed = object.__new__(TaskState)
            vars(changed).update(vars(task) | changes)  # `replace` sets thirty fields: most of a replay
            state = replace(state, step="") if state.step else state
    return state


def _with_money(state: RunState, stored: Stored) -> RunState:
    """What a record changes of costs and limits; with another limit what had ended early is made anew."""
    money = spend(state.money, stored)
    if money is state.money:
        return state
    if isinstance(stored.record, BudgetReached) and state.plan is None:
        state = replace(state, measures=tuple(map(TaskId.measure, range(stored.record.measures))))
    if isinstance(stored.record, BudgetSet) and state.money.reached is not None:
        state = _without(state, {MERGE, EVAL, DELIVER, *state.measures})
        state = replace(state, measures=state.measures if state.plan else ())
    return replace(state, money=money)


def _changes(task: TaskState, record: OfTask, time: float) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    match record:
        case TaskStarted():
            changes = {
                "status": Status.RUNNING,
                "attempts": record.attempt,
                "node": record.node,
                "where": (record.node_id, record.card),
                "begun": record.iteration,
                "since": time,
                "place": record.place,
            }
        case Progressed():
            changes = {"progress": record}
        case CheckpointSaved():
            changes = {"checkpoint": record.iteration, "saved": time, "failures": ()}
            changes |= dict.fromkeys(_IN_A_ROW, 0)
        case ModelSaved():
            changes = {
                "status": Status.DONE,
                "seconds": record.seconds,
                "iterations": record.iterations,
                "gaussians": record.gaussians,
                "held": False,
            }
        case Merged() | Delivered():
            changes = {"status": Status.DONE, "seconds": record.seconds}
        case Transferred():
            changes = {"received": task.received + record.received, "sent": task.sent + record.sent}
        case ScoresSaved() | PlanSaved() | MeasuresSaved() | EvaluationSaved():
            changes = {"status": Status.DONE, "seconds": _attempt(task, time) or None}
        case TaskFailed() | TaskYielded():
            changes = _end(task, record) | {"spent": task.spent + _attempt(task, time)}
        case PauseRequested() | UnpauseRequested() | RetryRequested():
            changes = _request(task, record)
        case PreviewSaved() | StopRequested():
            pass
        case _:
            assert_never(record)
    return changes


def _end(task: TaskState, record: TaskFailed | TaskYielded) -> dict[str, Any]:
    if isinstance(record, TaskYielded):
        return {"status": task.at_rest, "moves": task.moves + bool(record.leaves)}
    changes: dict[str, Any] = {
        "status": Status.FAILED if record.final else task.at_rest,
        "attempts": record.attempt,
        "retries": task.retries + (not record.final),
        "reasons": (*task.reasons, f"{record.reason}; {record.then}" if record.then else record.reason),
    }
    if record.excused:
        return changes
    if record.preempted:
        return changes | {"preemptions": task.preemptions + 1}
    if record.kind == Failure.MEMORY:
        changes |= {"shortages": task.shortages + 1, "starved": record.memory}
    else:
        changes["failures"] = (*task.failures, machines.Misfortune(record.kind, (record.node, record.card)))
    count = "losses" if record.kind == Failure.LOST else "errors"
    return changes | {count: getattr(task, count) + 1}


def _with_nodes(state: RunState, record: Record, time: float) -> RunState:
    where = state.task(record.task).where if isinstance(record.task, TaskId) else ()
    if isinstance(record, NodeQuarantined):
        _excuse(state, record)
    elif isinstance(record, NodeLeaving):
        state.notices[Noticed(None, machines.leave_text(record))] = None
    known = machines.follow(state.nodes, record, where, time)
    return state if known is state.nodes else replace(state, nodes=known)


def _excuse(state: RunState, record: NodeQuarantined) -> None:
    """Failures there count no longer, nor are they final unless the blocks are merged: in place."""
    for name in record.tasks:
        task = state.task(TaskId.parse(name))
        kinds = [failure.kind for failure in task.failures if record.node in failure.where]
        losses = kinds.count(Failure.LOST)
        revived = task.status == Status.FAILED and not state.joined(task.id)
        state.tasks[task.id] = replace(
            task,
            status=task.at_rest if revived else task.status,
            errors=max(0, task.errors - len(kinds) + losses),
            losses=max(0, task.losses - losses),
            failures=tuple(failure for failure in task.failures if record.node not in failure.where),
        )
    why = f"{record.host} ({record.node[:8]}) is in quarantine: {record.reason}"
    state.notices[Noticed(None, why)] = None


# A new driver may have other machines: earlier failures do not count.
_IN_A_ROW, _COUNTS = ("errors", "losses", "preemptions"), ("attempts", "shortages", "starved")
_FRESH: dict[str, Any] = {"failures": (), **dict.fromkeys([*_IN_A_ROW, *_COUNTS], 0)}


def _request(task: TaskState, record: PauseRequested | UnpauseRequested | RetryRequested) -> dict[str, Any]:
    held = {"held": isinstance(record, PauseRequested)}
    changes: dict[str, Any] = dict(_FRESH) if isinstance(record, RetryRequested) else held
    if task.status != Status.RUNNING:
        changes["status"] = replace(task, **changes).at_rest
    return changes


def _take_over(state: RunState, record: RunBegan, time: float) -> RunState:
    """Whatever another driver had running is waiting again, and what had failed gets new attempts."""
    end = record.previous or state.ended  # runs of older versions do not have the former
    left = {id: task for id, task in state.tasks.items() if task.status != Status.DONE}
    fresh = {id: replace(_interrupted(it, end), status=it.at_rest, **_FRESH) for id, it in left.items()}
    away = (*state.away, (end, time)) if state.began is not None and end is not None else state.away
    began = time if state.began is None else state.began
    kept = {} if state.outcome == Outcome.FAILED and not state.transient else machines.take_over(state.nodes)
    state = replace(state, tasks=state.tasks | fresh, began=began, driver=record, away=away, nodes=kept)
    return replace(state, outcome=None, reason="", transient=False, ended=None, step="", waiting="")


def _attempt(task: TaskState, time: float) -> float:
    """Seconds of the attempt that runs, up to a time; 0 if none does."""
    return time - task.since if task.status == Status.RUNNING and task.since is not None else 0.0


def _interrupted(task: TaskState, time: float | None) -> TaskState:
    """The task, if it was running, after the end of its driver at some time, None = unknown."""
    spent = task.spent if time is None else task.spent + _attempt(task, time)
    return replace(task, status=task.at_rest, spent=spent) if task.status == Status.RUNNING else task


def _outdate(state: RunState, task: TaskId) -> RunState:
    """A new model makes what was made of older ones worthless: unions, what trained on, the merge."""
    first, *_ = stages = state.following(task)
    if MERGE not in state.tasks and state.tasks.keys().isdisjoint(first):  # then nothing else has begun
        return state
    return _without(state, {EVAL, DELIVER, *state.measures, *(id for stage in stages for id in stage)})


def _without(state: RunState, tasks: set[TaskId]) -> RunState:
    kept = {id: task for id, task in state.tasks.items() if id not in tasks}
    return replace(state, tasks=kept, merged=None, metrics=None)
