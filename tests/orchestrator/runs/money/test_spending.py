"""The account of a run at times that the test sets, and its limits. A machine costs one unit per second."""

from dataclasses import replace
from datetime import datetime

import pytest

from panolog.orchestrator.runs.machines.nodes import OWN
from panolog.orchestrator.runs.money.account import settled, view_money
from panolog.orchestrator.runs.money.limits import Wanted, parse_deadline
from panolog.orchestrator.runs.money.prices import PriceList
from panolog.orchestrator.runs.money.records import BudgetSet, NodeReserved, NodeReturned, WorkLost
from panolog.orchestrator.runs.money.spending import Spending
from panolog.orchestrator.runs.records import (
    Outcome,
    Record,
    RunBegan,
    RunEnded,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, replay
from panolog.scene.errors import ConfigError
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.history import BEGAN, started

A, B = (NodeReserved(name, name, "kind", 3600.0) for name in ("node", "b"))
ONE, TWO = TaskId.block(1), TaskId.block(2)


def after(*records: tuple[float, Record]) -> RunState:
    return replay(Stored(i, time, record) for i, (time, record) in enumerate(records, 1))


def parts(money: Spending) -> tuple[float, float, float]:
    return money.used.cost, money.idle.cost, money.lost.cost


def test_a_machine_costs_from_when_it_comes_until_it_goes() -> None:
    state = after((0, BEGAN), (0, A), (5, B), (9, NodeReturned("b")), (20, RunEnded(Outcome.DONE)))
    assert parts(state.money) == pytest.approx((24, 24, 0))
    assert parts(state.money.until(100)) == pytest.approx((24, 24, 0))
    assert state.money.ahead(10) == 0


def test_the_machine_of_the_driver_costs_from_the_start_under_one_id() -> None:
    own, again = NodeReserved(OWN, "host", "kind", 3600.0), replace(A, before=OWN)
    state = after(
        (0, BEGAN),
        (0, own),
        (10, again),  # it has an id of Ray's by then
        (15, RunEnded(Outcome.FAILED)),
        (100, RunBegan("host", 1, True, 15)),
        (100, own),
        (107, again),
    )
    assert set(state.money.machines) == {"node"}
    assert parts(state.money.until(110)) == pytest.approx((25, 25, 0))


def test_what_follows_costs_all_machines_or_one_of_them_once_the_others_are_gone() -> None:
    money = after((0, BEGAN), (0, A), (0, B)).money
    each, other = (money.machines[name].priced(1.0).cost for name in ("node", "b"))
    assert money.ahead(100) == pytest.approx(100 * (each + other))
    assert money.ahead(100, idle=30) == pytest.approx(30 * (each + other) + 70 * max(each, other))
    assert money.ahead(20, idle=30) == pytest.approx(20 * (each + other))


def test_it_is_idle_while_no_task_runs_there() -> None:
    score = TaskId.shard(0)
    state = after(
        (0, BEGAN), (0, A), (3, started(score)), (7, ScoresSaved(score, "", 1)), (7, started(COARSE))
    )
    assert parts(state.money.until(12)) == pytest.approx((12, 3, 0))


def test_tasks_that_share_a_machine_bear_equal_parts_of_what_is_lost() -> None:
    lost = [(10.0, WorkLost(task, 10.0, 10.0)) for task in (ONE, TWO)]
    failed = [(10.0, TaskFailed(task, 1, "gone", final=False)) for task in (ONE, TWO)]
    records = [pair for both in zip(lost, failed, strict=True) for pair in both]
    state = after((0, BEGAN), (0, A), (0, started(ONE)), (0, started(TWO)), *records)
    assert parts(state.money.until(15)) == pytest.approx((15, 5, 10))


def test_what_a_task_has_saved_is_not_lost() -> None:
    state = after(
        (0, BEGAN), (0, A), (0, started(ONE)), (9, TaskYielded(ONE)), (9, RunEnded(Outcome.INTERRUPTED))
    )
    assert parts(settled(state, 50, running=False)) == pytest.approx((9, 0, 0))


def test_a_killed_driver_pays_until_its_last_record_and_loses_what_ran() -> None:
    state = after((0, BEGAN), (0, A), (2, started(ONE)), (8, started(TWO)))
    assert parts(settled(state, 50, running=False)) == pytest.approx((8, 2, 6))
    again = RunBegan("host", 2, resumed=True, previous=8.0)
    before: list[tuple[float, Record]] = [(0, BEGAN), (0, A), (2, started(ONE)), (8, started(TWO))]
    later = after(*before, (50, WorkLost(ONE, 6, 8)), (50, again))
    assert parts(later.money.until(60)) == pytest.approx((8, 2, 6))


def test_without_a_price_the_seconds_count() -> None:
    state = after((0, BEGAN), (0, NodeReserved("node", "node", "2 cores", None)), (4, started(COARSE)))
    money = state.money.until(10)
    assert (money.used.seconds, money.idle.seconds, money.used.cost, money.priced) == (10, 4, 0, False)


def test_a_line_about_one_machine_without_a_price_would_say_nothing() -> None:
    free = [(0.0, NodeReserved(name, name, "2 cores", None)) for name in ("node", "b")]
    lines = []
    for machines in (free[:1], free, [(0.0, A)]):
        view = view_money(after((0, BEGAN), *machines), 3600.0, running=True)
        assert view is not None
        lines.append(view.line())
    hours = "2.00 machine hours, 2.00 machine hours idle, 0.00 machine hours lost"
    assert lines[:2] == ["", hours] and lines[2].startswith("3,600.00 ")


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
