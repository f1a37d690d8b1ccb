"""What faults have cost a run, computed from its history.

A fault costs the work that the tasks it ended had done since their last checkpoint, and the time in which
fewer tasks ran than before or nothing was recorded. Faults whose effects may overlap count together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import dropwhile, pairwise

from benchmarks.chaos.faults import DAY_S, LIMITS, Kind
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    EvaluationSaved,
    Failure,
    MeasuresSaved,
    Merged,
    ModelSaved,
    PlanSaved,
    Preparing,
    Record,
    RunBegan,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.runs.state import RunState, Status, replay
from panolog.workers.tasks import TaskId

Done = ModelSaved | ScoresSaved | PlanSaved | Merged | MeasuresSaved | EvaluationSaved
Span = tuple[float, float]  # beginning and end, seconds since the epoch
_OF_DRIVER = (Kind.DRIVER, Kind.GCS, Kind.EDIT)  # end all tasks
_OF_READS = (Kind.BADNODE, Kind.EIO, Kind.CARD, Kind.VERSION)  # end a task when it next reads or starts


@dataclass(frozen=True)
class Fault:
    """One that was caused."""

    time: float  # seconds since the epoch
    kind: Kind
    what: str
    until: float = 0.0  # when it was ended; 0 = nothing did before the run's end

    @property
    def allowed(self) -> float:
        """Seconds that it may cost, besides a checkpoint interval."""
        return LIMITS[self.kind].costs + max(0.0, self.until - self.time)


@dataclass(frozen=True)
class FaultCost:
    """The cost of one fault, or of several that came close together."""

    faults: tuple[Fault, ...]
    tasks: tuple[TaskId, ...]  # those that ended
    redone: float  # seconds of work that was not in a checkpoint
    spans: tuple[Span, ...]  # in which work was lost

    @property
    def recovery(self) -> float:
        """Seconds in which fewer tasks ran, or nothing was recorded."""
        total, end = 0.0, float("-inf")
        for first, last in sorted(self.spans):
            total += max(0.0, last - max(first, end))
            end = max(end, last)
        return total

    @property
    def seconds(self) -> float:
        """Seconds that the faults have cost in all: of work done again, and of recovery."""
        return self.redone + self.recovery

    @property
    def allowed(self) -> float:
        """Seconds that the faults may cost, besides a checkpoint interval each."""
        return sum(fault.allowed for fault in self.faults)

    @property
    def window(self) -> Span:
        """In which another fault counts together with these: it may show what they did."""
        first = min((first for first, _ in self.spans), default=self.faults[0].time)
        last = max((last for _, last in self.spans), default=first)
        return first, last if self.tasks else max(last, first + self.allowed)


def true_times(history: Sequence[Stored], began: float) -> list[Stored]:
    """A history whose clock has jumped by whole days. Args: began, true time before its first record."""
    return [replace(stored, time=began + (stored.time - began) % DAY_S) for stored in history]


def fault_costs(history: Sequence[Stored], faults: Sequence[Fault]) -> list[FaultCost]:
    """The costs of all faults, in order. Args: history of the whole run, to its end; faults in order."""
    costs = [_cost(history, fault, _following(faults, number)) for number, fault in enumerate(faults)]
    groups: list[FaultCost] = []
    for cost in sorted(costs, key=lambda cost: cost.window):
        if groups and groups[-1].window[1] > cost.window[0]:
            groups[-1] = _together(groups[-1], cost)
        else:
            groups.append(cost)
    return groups


def longest_unsaved(history: Sequence[Stored]) -> float:
    """The longest time for which a task's work was in no file, in an undisturbed run, in seconds."""
    times: dict[TaskId, list[float]] = {}
    for stored in history:
        if isinstance(stored.record, TaskStarted | CheckpointSaved | Done):
            times.setdefault(stored.record.task, []).append(stored.time)
    return max(after - before for task in times.values() for before, after in pairwise(task))


def _following(faults: Sequence[Fault], number: int) -> float:
    """When the next fault came that ends tasks in the same way."""
    reads = faults[number].kind in _OF_READS
    later = (it for it in faults[number + 1 :] if it.kind == Kind.VERSION or (it.kind in _OF_READS) == reads)
    others = (fault.time for fault in later)
    return next(others, float("inf"))


def _cost(history: Sequence[Stored], fault: Fault, following: float) -> FaultCost:
    before = [stored for stored in history if stored.time <= fault.time]
    after = [stored for stored in history if stored.time > fault.time]
    meanwhile = [stored for stored in after if stored.time <= following]
    if fault.kind in _OF_READS:
        return _of_reads(history, fault, meanwhile)
    state = replay(before)
    ended = _ended(state, meanwhile, fault)
    redone = max((fault.time - _saved(before, task, fault.time) for task in ended), default=0.0)
    if fault.kind in _OF_DRIVER and not ended and before:  # between two tasks, or at the start
        redone = fault.time - before[-1].time
    spans = [(fault.time, _recovered(state, ended, after, fault))]
    if fault.until or (fault.kind in (Kind.CLOCK, Kind.HANG) and not ended):  # such as a hung calibration
        spans.append(_silence(before, after, fault))
    return FaultCost((fault,), ended, redone, tuple(spans))


def _of_reads(history: Sequence[Stored], fault: Fault, meanwhile: Sequence[Stored]) -> FaultCost:
    """Each attempt that cannot read loses its work since its checkpoint, and the time to the next start."""
    tasks: list[TaskId] = []
    redone, spans = 0.0, []
    for number, stored in enumerate(meanwhile):
        record = stored.record
        lost = isinstance(record, TaskFailed) and record.kind == Failure.LOST and fault.kind != Kind.VERSION
        if isinstance(record, TaskFailed) and not lost:
            tasks.append(record.task)
            redone += stored.time - _saved(_until(history, stored), record.task, stored.time)
            starts = (s.time for s in meanwhile[number:] if not _follows_alone(s.record))
            spans.append((stored.time, next(starts, meanwhile[-1].time)))
    return FaultCost((fault,), tuple(dict.fromkeys(tasks)), redone, tuple(spans))


def _follows_alone(record: Record) -> bool:
    """Whether a record does not show that work has been found for the place of a failed task."""
    return not isinstance(record, TaskStarted) and type(record).__name__ != "NodeQuarantined"


def _until(history: Sequence[Stored], last: Stored) -> list[Stored]:
    return [stored for stored in history if stored.id < last.id]


def _together(first: FaultCost, second: FaultCost) -> FaultCost:
    faults = sorted((*first.faults, *second.faults), key=lambda fault: fault.time)
    tasks = tuple(dict.fromkeys((*first.tasks, *second.tasks)))
    return FaultCost(tuple(faults), tasks, first.redone + second.redone, (*first.spans, *second.spans))


def _ended(state: RunState, meanwhile: Sequence[Stored], fault: Fault) -> tuple[TaskId, ...]:
    """The tasks that a fault ended: all of a driver; otherwise those that were lost before the next fault."""
    if fault.kind in _OF_DRIVER:
        return tuple(_running(state))
    records = [stored.record for stored in meanwhile]
    lost = [record for record in records if isinstance(record, TaskFailed) and record.kind == Failure.LOST]
    return tuple(dict.fromkeys(record.task for record in lost))


def _running(state: RunState) -> Iterator[TaskId]:
    return (name for name, task in state.tasks.items() if task.status == Status.RUNNING)


def _saved(before: Sequence[Stored], task: TaskId, otherwise: float) -> float:
    """Time of a task's last checkpoint or start."""
    times = [
        stored.time
        for stored in before
        if stored.record.task == task and isinstance(stored.record, TaskStarted | CheckpointSaved)
    ]
    return max(times, default=otherwise)


def _recovered(state: RunState, ended: Sequence[TaskId], after: Sequence[Stored], fault: Fault) -> float:
    """When as many tasks ran again as before the fault, or all that it ended."""
    if fault.kind in _OF_DRIVER:
        after = _of_next_driver(after)
    if not ended:
        return _next_step(after, fault.time) if fault.kind in _OF_DRIVER else fault.time
    wanted = len({*_running(state), *ended})
    missing, alive = set(ended), set(_running(state)) - set(ended)
    unnoticed = set() if fault.kind in _OF_DRIVER else set(ended)
    for stored in after:
        record = stored.record
        _follow(alive, record)
        if isinstance(record, TaskFailed):
            unnoticed.discard(record.task)
        if isinstance(record, TaskStarted) and not unnoticed:
            missing.discard(record.task)
            if len(alive) >= wanted or not missing:
                return stored.time
    return after[-1].time if after else fault.time


def _of_next_driver(after: Sequence[Stored]) -> list[Stored]:
    """Without what a driver recorded before it had noticed that it lost its cluster."""
    return list(dropwhile(lambda stored: not isinstance(stored.record, RunBegan), after))


def _follow(alive: set[TaskId], record: Record) -> None:
    if isinstance(record, TaskStarted):
        alive.add(record.task)
    elif isinstance(record, Done | TaskFailed):
        alive.discard(record.task)


def _silence(before: Sequence[Stored], after: Sequence[Stored], fault: Fault) -> Span:
    """The longest time without a record that began before a fault was ended."""
    times = [stored.time for stored in (*before[-1:], *after)]
    until = max(fault.time, fault.until)
    silences = [(max(first, fault.time), last) for first, last in pairwise(times) if first <= until]
    return max(silences, key=lambda span: span[1] - span[0], default=(until, until))


def _next_step(after: Sequence[Stored], otherwise: float) -> float:
    """When a driver that was killed between two tasks was followed by another that had Ray."""
    steps = (s.time for s in after if not isinstance(s.record, RunBegan) and not _connects(s))
    return next(steps, otherwise)


def _connects(stored: Stored) -> bool:
    return isinstance(stored.record, Preparing) and stored.record.step.startswith("connecting")
