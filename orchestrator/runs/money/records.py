"""The records of what a run costs: machines, work that was lost, and limits of cost and time.

They are a part of `records.Record`, apart from the others because `spending` alone replays them.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from panolog.workers.tasks import TaskId


class OfRun:
    """A record of no task, but of the whole run."""

    task: ClassVar[None] = None


@dataclass(frozen=True)
class NodeReserved(OfRun):
    """A machine is there for the run, whether it works or not."""

    node: str  # Node.id
    host: str
    kind: str  # name of its entry in the price list, else its instance type, its GPUs or its cores
    price: float | None  # currency units per hour; None = not known
    before: str = ""  # the id under which it was counted so far, if that was another


@dataclass(frozen=True)
class NodeReturned(OfRun):
    """A machine is there no longer."""

    node: str  # Node.id


@dataclass(frozen=True)
class WorkLost:
    """What an attempt has done since its last checkpoint has to be done again."""

    task: TaskId
    seconds: float
    until: float  # seconds since the epoch at which the attempt ended


@dataclass(frozen=True)
class BudgetSet(OfRun):
    """Limits and prices of the run from now on: they replace those before."""

    max_cost: float | None = None  # of all drivers of the run; None = no limit
    deadline: float | None = None  # seconds since the epoch; None = none
    prices: dict[str, Any] = field(default_factory=dict)  # a `PriceList`; {} = no prices


@dataclass(frozen=True)
class BudgetNear(OfRun):
    """Much of what a limit allows is used up."""

    what: str  # for people


@dataclass(frozen=True)
class BudgetReached(OfRun):
    """The training ends early: what follows is made of what there is."""

    reason: str  # for people: which limit, and what was foreseen
    measures: int = 0  # shards of the evaluation, where there is no plan; 0 = as the plan says, or one task


OfMoney = NodeReserved | NodeReturned | WorkLost | BudgetSet | BudgetNear | BudgetReached
