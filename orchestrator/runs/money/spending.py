"""What a run has cost so far, and what of that was wasted: a pure function of its records.

A machine costs its price from when the driver first sees it until it is gone or the driver has ended. While
several tasks run on it, each bears an equal part; while none does, it is idle. What an attempt has done since
its last checkpoint is lost when it ends without another. Nothing else is counted: no storage, no transfer,
and no machine while no driver is at work.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from panolog.orchestrator.runs.money.records import (
    BudgetNear,
    BudgetReached,
    BudgetSet,
    NodeReserved,
    NodeReturned,
    WorkLost,
)
from panolog.orchestrator.runs.records import (
    EvaluationSaved,
    MeasuresSaved,
    ModelSaved,
    RunBegan,
    RunEnded,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.workers.tasks import TaskId

_HOUR_S = 3600.0
_COUNTED = (
    *(NodeReserved, NodeReturned, WorkLost, BudgetSet, BudgetNear, BudgetReached),
    *(RunBegan, RunEnded, TaskStarted, ModelSaved, ScoresSaved, MeasuresSaved, EvaluationSaved),
    *(TaskFailed, TaskYielded),
)


@dataclass(frozen=True)
class Used:
    """Seconds of machines, and what they cost in currency units."""

    seconds: float = 0.0
    cost: float = 0.0

    def __add__(self, other: "Used") -> "Used":
        return Used(self.seconds + other.seconds, self.cost + other.cost)


@dataclass(frozen=True)
class PaidMachine:
    """One machine, as `NodeReserved` has described it last."""

    reserved_as: NodeReserved
    at: float  # seconds since the epoch up to which it is counted
    open: bool = True  # whether it is there now
    used: Used = Used()  # all of it
    idle: Used = Used()  # while no task ran there
    lost: Used = Used()  # what had to be done again
    tasks: int = 0  # that run there
    shared: float = 0.0  # seconds with tasks, each divided by how many there were

    def until(self, time: float) -> "PaidMachine":
        """The same, counted up to a time. An earlier one than before changes nothing."""
        seconds = time - self.at
        if not self.open or seconds <= 0:
            return self
        more = self.priced(seconds)
        return replace(
            self,
            at=time,
            used=self.used + more,
            idle=self.idle if self.tasks else self.idle + more,
            shared=self.shared + (seconds / self.tasks if self.tasks else 0.0),
        )

    def priced(self, seconds: float) -> Used:
        """So many seconds of it."""
        return Used(seconds, seconds * (self.reserved_as.price or 0.0) / _HOUR_S)


@dataclass(frozen=True)
class _Share:
    """A task that runs: where, and how much the machine had shared among tasks when it began."""

    node: str
    since: float
    shared: float


@dataclass(frozen=True)
class Spending:
    """All machines of a run by Node.id, and the limits of what it may cost."""

    machines: Mapping[str, PaidMachine] = field(default_factory=dict)
    running: Mapping[TaskId, _Share] = field(default_factory=dict)
    budget: BudgetSet | None = None  # the latest
    since: float | None = None  # seconds since the epoch at which that was set
    near: BudgetNear | None = None
    reached: BudgetReached | None = None  # the run ends early, or has

    def until(self, time: float) -> "Spending":
        """The same, counted up to a time in seconds since the epoch: what is there costs until then."""
        return replace(self, machines={id: machine.until(time) for id, machine in self.machines.items()})

    @property
    def used(self) -> Used:
        """All that was reserved."""
        return _sum(machine.used for machine in self.machines.values())

    @property
    def idle(self) -> Used:
        """What was reserved while no task ran there."""
        return _sum(machine.idle for machine in self.machines.values())

    @property
    def lost(self) -> Used:
        """What had to be done again."""
        return _sum(machine.lost for machine in self.machines.values())

    def ahead(self, seconds: float, idle: float | None = None) -> float:
        """What so many seconds more cost, in currency units.

        Args: idle, seconds after which the machines that are not needed go, all but one; None = they stay.
        """
        there = [machine.priced(1.0).cost for machine in self.machines.values() if machine.open]
        together = seconds if idle is None else min(idle, seconds)
        return sum(there) * together + max(there, default=0.0) * (seconds - together)

    @property
    def priced(self) -> bool:
        """Whether the price of any machine is known."""
        return any(machine.reserved_as.price is not None for machine in self.machines.values())

    @property
    def currency(self) -> str:
        """Of all costs; "" if there are no prices."""
        return str(self.budget.prices.get("currency", "")) if self.budget else ""

    def with_lost(self, record: WorkLost) -> "Spending":
        """The same with work that was lost: of its machine, what the task bore on average while it ran."""
        share = self.running.get(record.task)
        if share is None or share.node not in self.machines:
            return self
        machine = self.machines[share.node].until(record.until)
        span = max(record.until - share.since, 1e-9)
        part = min(1.0, (machine.shared - share.shared) / span)
        lost = machine.lost + machine.priced(record.seconds * part)
        return replace(self, machines={**self.machines, share.node: replace(machine, lost=lost)})


def spend(spending: Spending, stored: Stored) -> Spending:
    """What a run has cost after one more record."""
    record, time = stored.record, stored.time
    if not isinstance(record, _COUNTED):
        return spending
    match record:
        case NodeReserved():
            known = spending.machines.get(record.node)
            new = PaidMachine(record, time)
            if known is not None:
                new = replace(known.until(time), reserved_as=record, at=max(time, known.at), open=True)
            return _with(spending, record.node, new)
        case NodeReturned():
            machine = spending.machines.get(record.node)
            return spending if machine is None else _with(spending, record.node, _closed(machine, time))
        case WorkLost():
            return spending.with_lost(record)
        case BudgetSet():
            return replace(spending, budget=record, since=time, near=None, reached=None)
        case BudgetNear():
            return replace(spending, near=record)
        case BudgetReached():
            return replace(spending, reached=record)
        case RunEnded():
            machines = {id: _closed(machine, time) for id, machine in spending.machines.items()}
            return replace(spending, machines=machines)
        case RunBegan():  # one that was killed has recorded no end
            end = time if record.previous is None else record.previous
            machines = {id: replace(_closed(m, end), tasks=0) for id, m in spending.machines.items()}
            return replace(spending, machines=machines, running={})
        case TaskStarted():
            return _started(_ended(spending, record.task, time), record, time)
        case _:
            return _ended(spending, record.task, time)


def _sum(parts: Iterable[Used]) -> Used:
    return sum(parts, Used())


def _with(spending: Spending, node: str, machine: PaidMachine) -> Spending:
    return replace(spending, machines={**spending.machines, node: machine})


def _closed(machine: PaidMachine, time: float) -> PaidMachine:
    return replace(machine.until(time), open=False)


def _started(spending: Spending, record: TaskStarted, time: float) -> Spending:
    machine = spending.machines.get(record.node_id)
    if machine is None:
        return spending
    machine = machine.until(time)
    share = _Share(record.node_id, time, machine.shared)
    spending = _with(spending, record.node_id, replace(machine, tasks=machine.tasks + 1))
    return replace(spending, running={**spending.running, record.task: share})


def _ended(spending: Spending, task: TaskId, time: float) -> Spending:
    if (share := spending.running.get(task)) is None:
        return spending
    running = {id: other for id, other in spending.running.items() if id != task}
    machine = spending.machines[share.node].until(time)
    machine = replace(machine, tasks=machine.tasks - 1)
    return replace(_with(spending, share.node, machine), running=running)
