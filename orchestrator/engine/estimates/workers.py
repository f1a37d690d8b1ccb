"""What a job takes on one machine and on more of the kind: time, machine hours and cost.

All machines are counted from the start of the run to its end. What is estimated with several is what the
estimator expects of so many machines; with `--blocks auto` each number of them has its own blocks.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.money.prices import PriceList, reserved
from panolog.orchestrator.runs.units import duration

WORKERS = (1, 2, 4, 8, 16)  # each twice the one before
_PAYS = 0.75  # of the time with half as many: half of what twice as many could save
_BAR = 30  # characters


@dataclass(frozen=True)
class WorkersRow:
    """A job on so many machines."""

    workers: int
    blocks: str
    seconds: float
    machine_hours: float
    cost: float | None  # None = there is no price


@dataclass(frozen=True)
class Workers:
    """The rows, and the machine that they are of."""

    kind: str
    price: float | None  # per hour
    currency: str
    rows: tuple[WorkersRow, ...] = ()  # none if nothing was measured

    @property
    def knee(self) -> int | None:
        """The most machines up to which each doubling takes at least a quarter off the time."""
        if not self.rows:
            return None
        best = self.rows[0]
        for row in self.rows[1:]:
            if row.seconds > _PAYS * best.seconds:
                break
            best = row
        return best.workers

    def as_json(self) -> dict[str, Any]:
        """What doctor prints; seconds, hours and currency units."""
        return asdict(self) | {"knee": self.knee}

    def lines(self) -> list[str]:
        """A table with bars of the time, and the knee marked."""
        if not self.rows:
            return []
        longest = max(row.seconds for row in self.rows)
        price = f", {self.price:g} {self.currency} per hour" if self.price is not None else ""
        money = f"{self.currency:>12}" if self.price is not None else ""
        found = [f"workers of {self.kind}{price}", f"{'workers':>9}{'time':>10}{'machine hours':>15}{money}"]
        for i, row in enumerate(self.rows):
            cost = "" if row.cost is None else f"{row.cost:>12,.2f}"
            bar = "█" * max(1, round(_BAR * row.seconds / longest))
            note = "  more machines save little time" if row.workers == self.knee else ""
            note = "  no faster" if i and row.seconds >= self.rows[i - 1].seconds else note
            time = f"{duration(row.seconds):>10}{row.machine_hours:>15.2f}"
            found.append(f"{row.workers:>9}{time}{cost}  {bar}{note}")
        return found


def workers(
    estimator: Callable[[Sequence[Node]], Estimator], nodes: Sequence[Node], prices: PriceList | None
) -> Workers:
    """The estimates of a job on machines as the best of those that there are.

    Args: estimator, of the job on some machines.
    """
    node = max(nodes, key=lambda node: (len(node.gpus), node.cpus, node.memory))
    price = None if prices is None else reserved(node, prices)
    rows = []
    for count in WORKERS:
        found = estimator([replace(node, id=f"{node.id}-{number}") for number in range(count)])
        seconds = found.estimate().seconds
        if seconds is None or not math.isfinite(seconds):
            break
        hours = count * seconds / 3600
        cost = None if price is None or price.price is None else hours * price.price
        rows.append(WorkersRow(count, found.config.blocks, seconds, hours, cost))
    kind = reserved(node, prices).kind
    return Workers(kind, price.price if price else None, prices.currency if prices else "", tuple(rows))
