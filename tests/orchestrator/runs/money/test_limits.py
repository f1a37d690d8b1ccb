from datetime import datetime

import pytest

from panolog.orchestrator.runs.money.limits import Wanted, parse_deadline
from panolog.orchestrator.runs.money.prices import PriceList
from panolog.orchestrator.runs.money.records import BudgetSet, NodeReserved
from panolog.orchestrator.runs.records import Outcome, Record, RunBegan, RunEnded, Stored
from panolog.orchestrator.runs.state import RunState, replay
from panolog.scene.errors import ConfigError

NOW = datetime(2026, 11, 24, 23, 0).timestamp()  # of this machine
PRICES = PriceList.model_validate({"currency": "USD", "machine": [{"name": "a", "price": 3600, "host": "*"}]})


@pytest.mark.parametrize(
    ("text", "when"),
    [
        ("1d 2h", NOW + 93_600),
        ("23:30", NOW + 1800),  # the next time of day
        ("22:00", NOW + 23 * 3600),
        ("2026-11-25T00:00:00", NOW + 3600),
        ("2026-12-01T00:00:00Z", datetime.fromisoformat("2026-12-01T00:00:00+00:00").timestamp()),
    ],
)
def test_a_deadline_is_a_duration_or_a_time(text: str, when: float) -> None:
    assert parse_deadline(text, NOW) == when


@pytest.mark.parametrize("text", ["", "soon", "25:00", "12:60", "2020-01-01", "99999d", "0s"])
def test_what_is_no_deadline_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--deadline"):
        parse_deadline(text, NOW)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "five"])
def test_what_is_no_amount_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--max-cost"):
        Wanted.of(text, None, PRICES)


def spent(*more: Stored) -> RunState:
    budget = Wanted.of("10", None, PRICES).budget(RunState())
    assert budget is not None
    records: list[Record] = [RunBegan("host", 1, False), budget, NodeReserved("n", "host", "a", 3600.0)]
    stored = [Stored(i, 0.0, record) for i, record in enumerate(records, 1)]
    return replay([*stored, Stored(9, 8.0, RunEnded(Outcome.LIMITED)), *more])


def test_what_a_command_was_not_given_stays() -> None:
    state = spent()
    assert Wanted().budget(state) is None
    assert Wanted.of("10", None, None).budget(state) is None
    higher = Wanted.of("20", None, None).budget(state)
    assert higher is not None
    assert (higher.max_cost, higher.prices["currency"]) == (20.0, "USD")
    assert Wanted.of("none", None, None).budget(state) == BudgetSet(None, None, higher.prices)


def test_a_limit_that_is_used_up_or_has_no_prices_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"the run has cost 8\.00 already"):
        Wanted.of("7", None, None).budget(spent())
    with pytest.raises(ConfigError, match="there are no prices"):
        Wanted.of("7", None, None).budget(RunState())


def test_another_command_gets_the_same() -> None:
    wanted = Wanted.of("2.5", "none", PRICES)
    words = wanted.options()
    given = dict(zip(words[::2], words[1::2], strict=True))
    assert (given["--max-cost"], given["--deadline"]) == ("2.5", "none")
    assert PriceList.model_validate_json(given["--prices"]) == PRICES
    later = Wanted.of(None, "6h", None)
    again = Wanted.of(None, later.options()[1], None)
    assert again.deadline == pytest.approx(later.deadline)
