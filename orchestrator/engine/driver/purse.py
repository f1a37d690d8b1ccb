"""The money and the time of a run: what it reserves and loses, and when a limit ends its training early.

The training ends when what is left of a limit is just enough for what follows: last checkpoints, merge,
evaluation and delivery.
"""

import math
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.driver.local_pool import own_node
from panolog.orchestrator.engine.estimates.costs import slowness
from panolog.orchestrator.engine.scheduling.scaling import STARTUP_S
from panolog.orchestrator.runs.clock import Clock
from panolog.orchestrator.runs.machines.nodes import OWN, Node
from panolog.orchestrator.runs.money import prices
from panolog.orchestrator.runs.money.account import lost_at
from panolog.orchestrator.runs.money.records import (
    BudgetNear,
    BudgetReached,
    BudgetSet,
    NodeReturned,
    OfMoney,
)
from panolog.orchestrator.runs.records import Noticed, Record, TaskFailed
from panolog.orchestrator.runs.state import RunState, Status
from panolog.orchestrator.runs.units import duration
from panolog.scene.errors import ConfigError, RunError
from panolog.workers.tasks import AFTER_TRAINING, EVAL, MERGE

_UNSURE = 1.2  # times what is estimated of what follows the training: that was up to a fifth too low
_TURN_S = 2.0  # in which tasks take note of a stop, and the driver of their end
_NEAR = 0.8  # of a limit, from which on people are warned


@dataclass(frozen=True)
class _Limit:
    """One limit of a run at a moment, in its own unit."""

    name: str  # for people, with its value
    allowed: float
    used: float
    needed: float  # for what follows the training
    text: str  # what is used and needed, for people


def after_training(estimate: Mapping[str, float | None] | None) -> float:
    """Seconds that merge, evaluation and delivery are expected to take; of an unknown part, none.

    Args: estimate, `PreflightSaved.seconds`.
    """
    return sum((estimate or {}).get(stage) or 0.0 for stage in AFTER_TRAINING)


def verdict(
    state: RunState, now: float, saving: float, idle: float | None = None
) -> BudgetNear | BudgetReached | None:
    """Whether a limit ends the training now, or is near; None if neither is new.

    Args: now, seconds since the epoch; saving, seconds in which the tasks that train save a checkpoint; idle,
    as `Spending.ahead`: then a machine has to start again after the merge.
    """
    money = state.money
    if money.budget is None or money.reached is not None or state.status(MERGE) == Status.DONE:
        return None
    limits = _limits(
        state,
        money.budget,
        now,
        _UNSURE * slowness(state) * after_training(state.estimate) + saving + _TURN_S,
        idle,
    )
    for limit in limits:
        if limit.used + limit.needed >= limit.allowed:
            return BudgetReached(f"{limit.name} is reached: {limit.text}")
    near = [limit for limit in limits if limit.used >= _NEAR * limit.allowed]
    if near and money.near is None:
        return BudgetNear(f"{near[0].name}: {near[0].text}")
    return None


def _limits(
    state: RunState, budget: BudgetSet, now: float, needed: float, idle: float | None
) -> list[_Limit]:
    """Args: needed, seconds for what follows the training, on machines that are there; idle, as `verdict`."""
    needed += 0.0 if idle is None else STARTUP_S
    found, money = list[_Limit](), state.money.until(now)
    later = "saving, merge, evaluation and delivery need about"
    if budget.max_cost is not None:
        used, cost = money.used.cost, money.ahead(needed, idle)
        name = f"the limit of {budget.max_cost:g} {money.currency}"
        text = f"{used:.2f} {money.currency} are used, and {later} {cost:.2f}"
        found.append(_Limit(name, budget.max_cost, used, cost, text))
    if budget.deadline is not None and state.money.since is not None:
        since = min(state.money.since, now)
        name = f"the deadline {datetime.fromtimestamp(budget.deadline).astimezone():%Y-%m-%d %H:%M:%S}"
        left = duration(max(0.0, budget.deadline - now))
        text = f"{left} are left, and {later} {duration(needed)}"
        found.append(_Limit(name, budget.deadline - since, now - since, needed, text))
    return found


def require_left(state: RunState, now: float) -> None:
    """Raises ConfigError at a limit that is used up before anything has been trained.

    Args: now, seconds since the epoch.
    """
    budget = state.money.budget
    for limit in _limits(state, budget, now, 0.0, None) if budget else ():
        if limit.used >= limit.allowed:
            raise ConfigError(
                f"{limit.name} is reached before there is a scene to train: `panolog resume` with more"
                " completes it"
            )


def require_enough(
    estimate: Mapping[str, float | None],
    budget: BudgetSet,
    nodes: Sequence[Node],
    now: float,
    used: float = 0.0,
) -> None:
    """Raises ConfigError if a new run could not train at all within a budget.

    Args: estimate, as `after_training`; now, seconds since the epoch; used, what scene and preflight have
    cost, in currency units.
    """
    rate = sum(prices.reserved(node, prices.prices_of(budget)).price or 0.0 for node in nodes) / 3600
    needed = _UNSURE * after_training(estimate) + _TURN_S
    what = f"merge, evaluation and delivery alone need about {duration(needed)}"
    if budget.max_cost is not None and used + rate * needed >= budget.max_cost:
        cost = f"{rate * needed:.2g} {budget.prices.get('currency', '')}"
        spent = f", and {used:.2g} are used" if used else ""
        raise ConfigError(f"--max-cost {budget.max_cost:g}: {what}, which cost {cost}{spent}; give more")
    left = math.inf if budget.deadline is None else budget.deadline - now
    if left <= needed:
        raise ConfigError(f"--deadline: {duration(max(0.0, left))} are left, and {what}; give more")


def reserve_own(journal: Journal) -> None:
    """Records that the driver's machine costs from now on, before there is a pool, unless it does already."""
    own, budget = journal.state.money.machines.get(OWN), journal.state.money.budget
    if own is None or not own.open:
        journal.record([prices.reserved(own_node(), prices.prices_of(budget))])


class Purse:
    """Keeps the account of a run."""

    def __init__(self, journal: Journal, clock: Clock) -> None:
        """Raises ConfigError if the run's prices are of another format."""
        self._journal = journal
        self._clock = clock
        self._seen: tuple[Node, ...] = ()
        own = journal.state.money.machines.get(OWN)
        self._own = own is not None and own.open  # the driver's machine is counted since before the pool
        self._stranded: float | None = None  # Clock.monotonic(): no machine since then, after a limit
        self._prices = prices.prices_of(journal.state.money.budget)

    def see(self, nodes: tuple[Node, ...]) -> None:
        """Records which machines have come and gone, and of which another share is the run's."""
        if nodes == self._seen and not self._own:
            return
        before = {node.id: node.share for node in self._seen}
        new = [prices.reserved(n, self._prices) for n in nodes if before.get(n.id) != n.share]
        gone = before.keys() - {node.id for node in nodes}
        if self._own:
            self._own, host = False, socket.gethostname()
            here = next((number for number, node in enumerate(nodes) if node.host == host), None)
            if here is None:  # a head without cores
                gone |= {OWN}
            else:
                new[here] = replace(new[here], before=OWN)
        records: list[OfMoney] = [*new, *map(NodeReturned, sorted(gone))]
        self._seen = nodes
        self._journal.record(records)

    def reached(self, saving: float, idle: float | None = None) -> BudgetReached | None:
        """The limit that ends the training now; records that one is near. Args: as `verdict`."""
        found = verdict(self._journal.state, self._clock.time(), saving, idle)
        if isinstance(found, BudgetNear):
            self._journal.record([found])
            return None
        return found

    def gives_up(self, patience: float) -> str:
        """The limit, if after it there has been no machine for so many seconds; else "".

        Called while nothing runs. Args: patience, for which the evaluation waits for a machine.
        """
        state, now = self._journal.state, self._clock.monotonic()
        if state.money.reached is None or not state.waiting:
            self._stranded = None
            return ""
        self._stranded = now if self._stranded is None else self._stranded
        if now - self._stranded < patience:
            return ""
        line = f"not evaluated: no machine for {duration(patience)} after the limit; `panolog eval` does that"
        self._journal.record([Noticed(EVAL, line)])
        return state.money.reached.reason

    def require(self, idle: float | None = None) -> None:
        """Raises RunError at a limit while the disk takes nothing: the run ends. Args: as `verdict`."""
        found = verdict(self._journal.state, self._clock.time(), 0.0, idle)
        if isinstance(found, BudgetReached):
            raise RunError(f"{self._journal.state.waiting}, and {found.reason}")

    def with_lost(self, records: Sequence[Record]) -> list[Record]:
        """Records, and before each failure what is lost by it."""
        state, now, found = self._journal.state, self._clock.time(), list[Record]()
        for record in records:
            if isinstance(record, TaskFailed):
                found += lost_at(state.task(record.task), now)
            found.append(record)
        return found
