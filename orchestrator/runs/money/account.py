"""What a run has cost, as people and programs read it, and what is lost when an attempt or a driver ends."""

from collections import defaultdict

from pydantic import BaseModel, ConfigDict

from panolog.orchestrator.runs.money.records import WorkLost
from panolog.orchestrator.runs.money.spending import PaidMachine, Spending, Used
from panolog.orchestrator.runs.state import RunState, Status, TaskState


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True)


class UsedView(_Model):
    """Seconds of machines, and their cost; None where no price is known."""

    seconds: float
    cost: float | None


class MachineKindView(_Model):
    """All machines of one kind; `there` counts those that are there now, `price` is per hour."""

    kind: str
    price: float | None
    count: int
    there: int
    used: UsedView
    idle: UsedView
    lost: UsedView


class MoneyView(_Model):
    """The account of a run: all that was reserved, and what of it was idle or had to be done again.

    `rate` is per hour of what is there now, `deadline` in epoch seconds. No storage is counted.
    """

    currency: str
    used: UsedView
    idle: UsedView
    lost: UsedView
    rate: float | None
    max_cost: float | None
    deadline: float | None
    reached: str | None  # the limit that has ended the training early
    kinds: tuple[MachineKindView, ...]

    def text(self, used: UsedView) -> str:
        """A part of the account: its cost, or its hours where no price is known."""
        return hours(used.seconds) if used.cost is None else f"{used.cost:,.2f} {self.currency}"

    def line(self) -> str:
        """The account in one line; "" where it says nothing: of one machine without a price."""
        if self.used.cost is None and sum(kind.count for kind in self.kinds) < 2:
            return ""
        limit = f" of at most {self.max_cost:,.2f}" if self.max_cost is not None else ""
        parts = [f"{self.text(self.used)}{limit}"]
        if self.used.cost is not None:
            parts.append(hours(self.used.seconds))
        parts += [f"{self.text(self.idle)} idle", f"{self.text(self.lost)} lost"]
        return ", ".join(parts)


def lost_at(task: TaskState, end: float) -> list[WorkLost]:
    """What is lost of a task whose attempt ends then, seconds since the epoch, without a checkpoint."""
    if task.status != Status.RUNNING or task.since is None:
        return []
    since = max(task.since, task.saved or task.since)
    return [WorkLost(task.id, max(0.0, end - since), end)]


def lost_with_driver(state: RunState) -> list[WorkLost]:
    """What the last driver of a run has lost by ending."""
    end = state.ended or state.latest
    return [] if end is None else [lost for task in state.tasks.values() for lost in lost_at(task, end)]


def settled(state: RunState, end: float, *, running: bool) -> Spending:
    """The account of a run up to a time, with what a driver has lost that is gone.

    Args: end, seconds since the epoch; running, whether a driver works on the run.
    """
    if running:
        return state.money.until(end)
    return state.money.with_lost(lost_with_driver(state)).until(state.ended or state.latest or end)


def view_money(state: RunState, end: float, *, running: bool) -> MoneyView | None:
    """The account of a run; None of one that has recorded no machines.

    Args: end, seconds since the epoch; running, whether a driver works on it.
    """
    money = settled(state, end, running=running)
    if not money.machines:
        return None
    budget, priced = money.budget, money.priced
    return MoneyView(
        currency=money.currency,
        used=_used(money.used, priced=priced),
        idle=_used(money.idle, priced=priced),
        lost=_used(money.lost, priced=priced),
        rate=money.ahead(3600.0) if priced else None,
        max_cost=budget.max_cost if budget else None,
        deadline=budget.deadline if budget else None,
        reached=money.reached.reason if money.reached else None,
        kinds=_kinds(money),
    )


def hours(seconds: float) -> str:
    """Seconds of machines for people."""
    return f"{seconds / 3600:.2f} machine hours"


def _kinds(money: Spending) -> tuple[MachineKindView, ...]:
    kinds = defaultdict[tuple[str, float | None], list[PaidMachine]](list)
    for machine in money.machines.values():
        kinds[machine.reserved_as.kind, machine.reserved_as.price].append(machine)
    views = [_kind(kind, price, machines) for (kind, price), machines in kinds.items()]
    return tuple(sorted(views, key=lambda view: (-view.used.seconds, view.kind)))


def _kind(kind: str, price: float | None, machines: list[PaidMachine]) -> MachineKindView:
    own, priced = Spending({machine.reserved_as.node: machine for machine in machines}), price is not None
    return MachineKindView(
        kind=kind,
        price=price,
        count=len(machines),
        there=sum(machine.open for machine in machines),
        used=_used(own.used, priced=priced),
        idle=_used(own.idle, priced=priced),
        lost=_used(own.lost, priced=priced),
    )


def _used(used: Used, *, priced: bool) -> UsedView:
    return UsedView(seconds=used.seconds, cost=used.cost if priced else None)
