"""What a user allows a run: `--max-cost` and `--deadline`, and the budget of a run that they make."""

import json
import math
import re
import time
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from panolog.orchestrator.runs.money.prices import PriceList
from panolog.orchestrator.runs.money.records import BudgetSet
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.runs.units import DURATION, seconds_of
from panolog.scene.errors import ConfigError

NONE = "none"  # removes a limit
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})")
_MOST_S = 10 * 365 * 86_400.0  # a deadline beyond is a typing error


@dataclass(frozen=True)
class Wanted:
    """What a command was given of a budget; what it was not given stays as it is."""

    max_cost: float | None = None
    deadline: float | None = None  # seconds since the epoch
    prices: PriceList | None = None
    removed: frozenset[str] = frozenset()  # of "max_cost" and "deadline"

    @staticmethod
    def of(max_cost: str | None, deadline: str | None, prices: PriceList | None) -> "Wanted":
        """From the options of a command, now. Raises ConfigError for what is none."""
        removed = {name for name, text in (("max_cost", max_cost), ("deadline", deadline)) if text == NONE}
        cost = None if max_cost is None or max_cost == NONE else _amount(max_cost)
        until = None if deadline is None or deadline == NONE else parse_deadline(deadline, time.time())
        return Wanted(cost, until, prices, frozenset(removed))

    def options(self) -> list[str]:
        """The options of another command that mean the same."""
        words = [word for name in sorted(self.removed) for word in (f"--{name.replace('_', '-')}", NONE)]
        if self.max_cost is not None:
            words += ["--max-cost", repr(self.max_cost)]
        if self.deadline is not None:
            words += ["--deadline", datetime.fromtimestamp(self.deadline).astimezone().isoformat()]
        if self.prices is not None:
            words += ["--prices", json.dumps(self.prices.model_dump(mode="json", exclude_none=True))]
        return words

    def budget(self, state: RunState) -> BudgetSet | None:
        """The budget of a run that a command is to start or resume; None if it stays as it is.

        Raises ConfigError for a limit that the run has reached already, or one of cost without prices.
        """
        before = state.money.budget or BudgetSet()
        after = before
        if "max_cost" in self.removed or self.max_cost is not None:
            after = replace(after, max_cost=self.max_cost)
        if "deadline" in self.removed or self.deadline is not None:
            after = replace(after, deadline=self.deadline)
        if self.prices is not None:
            after = replace(after, prices=self.prices.model_dump(mode="json", exclude_none=True))
        if after == before:
            return None
        _check(after, state)
        return after


def _check(budget: BudgetSet, state: RunState) -> None:
    if budget.max_cost is None:
        return
    if not budget.prices:
        raise ConfigError(
            f"--max-cost {budget.max_cost:g}: there are no prices: give --prices FILE, or write"
            " ~/.config/panolog/prices.toml; docs/money.md has an example"
        )
    if (cost := state.money.used.cost) >= budget.max_cost:
        raise ConfigError(f"--max-cost {budget.max_cost:g}: the run has cost {cost:.2f} already; give more")


def _amount(text: str) -> float:
    try:
        amount = float(text)
    except ValueError:
        amount = math.nan
    if not 0 < amount < math.inf:
        raise ConfigError(f"--max-cost {text}: give an amount in the currency of the prices, or none")
    return amount


def parse_deadline(text: str, now: float) -> float:
    """Seconds since the epoch of a time or a duration from now: "6h", "1h30m", "08:00" or an ISO time.

    Args: now, seconds since the epoch. A time without a zone is of this machine's; one without a day is the
    next. Raises ConfigError for what is none, or is over.
    """
    found = seconds_of(text)
    when = now + found if found is not None else _time(text, now)
    if when is None:
        raise ConfigError(f"--deadline {text}: write {DURATION}, 08:00, 2026-12-24T08:00, or none")
    if not now < when < now + _MOST_S:
        over = "is over" if when <= now else "is more than ten years away"
        raise ConfigError(f"--deadline {text}: {over}")
    return when


def _time(text: str, now: float) -> float | None:
    if found := _CLOCK.fullmatch(text):
        hour, minute = map(int, found.groups())
        if hour > 23 or minute > 59:
            return None
        today = datetime.fromtimestamp(now).replace(hour=hour, minute=minute, second=0, microsecond=0)
        return (today if today.timestamp() > now else today + timedelta(days=1)).timestamp()
    try:
        return datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError):
        return None
