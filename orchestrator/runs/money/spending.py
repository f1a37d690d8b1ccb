"""What a run has cost so far, and what of that was wasted: a pure function of its records.

A machine costs its price from when the driver first sees it, its own from when it begins, until it is gone or
the driver has ended. Several tasks on it bear equal parts; while none runs, it is idle. What an attempt has
done since its last checkpoint is lost when it ends without another. Nothing else is counted.
"""

from collections.abc import Iterable
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
        """This machine, counted up to a time. An earlier one than before changes nothing."""
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

    def with_used(self, other: "PaidMachine") -> "PaidMachine":
        """This machine, with what it has cost under another id added."""
        used, idle, lost = self.used + other.used, self.idle + other.idle, self.lost + other.lost
        return replace(self, used=used, idle=idle, lost=lost)

    def priced(self, seconds: float) -> Used:
        """What `seconds` of this machine cost."""
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

    machines: dict[str, PaidMachine] = field(default_factory=dict)
    running: dict[TaskId, _Share] = field(default_factory=dict)
    budget: BudgetSet | None = None  # the latest
    since: float | None = None  # seconds since the epoch at which that was set
    near: BudgetNear | None = None
    reached: BudgetReached | None = None  # the run ends early, or has

    def until(self, time: float) -> "Spending":
        """This spending, counted up to a time in seconds since the epoch: what is there costs until then."""
        return replace(self, machines={id: machine.until(time) for id, machine in self.machines.items()})

    @property
    def used(self) -> Used:
        """All that was reserved."""
        return sum((machine.used for machine in self.machines.values()), Used())

    @property
    def idle(self) -> Used:
        """What was reserved while no task ran there."""
        return sum((machine.idle for machine in self.machines.values()), Used())

    @property
    def lost(self) -> Used:
        """What had to be done again."""
        return sum((machine.lost for machine in self.machines.values()), Used())

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
        """The currency of all costs; "" if there are no prices."""
        return str(self.budget.prices.get("currency", "")) if self.budget else ""

    def with_lost(self, records: Iterable[WorkLost]) -> "Spending":
        """This spending with lost work: what its task bore of its machine, on average while it ran."""
        machines = dict(self.machines)
        for record in records:
            share = self.running.get(record.task)
            if share is not None and share.node in machines:
                machine = machines[share.node].until(record.until)
                part = min(1.0, (machine.shared - share.shared) / max(record.until - share.since, 1e-9))
                lost = machine.lost + machine.priced(record.seconds * part)
                machines[share.node] = replace(machine, lost=lost)
        return replace(self, machines=machines)


def spend(spending: Spending, stored: Stored) -> Spending:
    """What a run has cost after one more record; in place for machines and for what runs."""
    record, time = stored.record, stored.time
    if not isinstance(record, _COUNTED):
        return spending
    machines, running = spending.machines, spending.running
    match record:
        case NodeReserved():
            own = machines.pop(record.before, None)
            known = machines.get(record.node) or PaidMachine(record, time)
            known = known if own is None else known.with_used(own.until(time))
            at = max(time, known.at)
            machines[record.node] = replace(known.until(time), reserved_as=record, at=at, open=True)
        case NodeReturned() if record.node in machines:
            machines[record.node] = _closed(machines[record.node], time)
        case WorkLost():
            return spending.with_lost([record])
        case BudgetSet():
            return replace(spending, budget=record, since=time, near=None, reached=None)
        case BudgetNear():
            return replace(spending, near=record)
        case BudgetReached():
            return replace(spending, reached=record)
        case RunEnded():
            machines |= {id: _closed(machine, time) for id, machine in machines.items()}
        case RunBegan(previous=before):  # one that was killed has recorded no end
            end = time if before is None else before
            machines |= {id: replace(_closed(machine, end), tasks=0) for id, machine in machines.items()}
            running.clear()
        case _:
            if record.task is not None and (share := running.pop(record.task, None)):
                machine = machines[share.node].until(time)
                machines[share.node] = replace(machine, tasks=machine.tasks - 1)
    if isinstance(record, TaskStarted) and record.node_id in machines:
        machine = machines[record.node_id].until(time)
        machines[record.node_id] = replace(machine, tasks=machine.tasks + 1)
        running[record.task] = _Share(record.node_id, time, machine.shared)
    return spending


def _closed(machine: PaidMachine, time: float) -> PaidMachine:
    return replace(machine.until(time), open=False)
