"""How long blocks take, and a job on more machines."""

import pytest

from panolog.orchestrator.engine.estimates.costs import BlockTime, CostModel, block_times, fit, seconds_left
from panolog.orchestrator.engine.estimates.workers import Workers, WorkersRow
from panolog.orchestrator.runs.records import BlockPlan, PlanSaved, Progressed
from panolog.orchestrator.runs.state import TaskState
from panolog.workers.tasks import TaskId
from tests.orchestrator.history import after, model, started

BLOCKS = [(c, g) for c in (5, 20, 80) for g in (1_000, 30_000)]
ZERO, ONE = TaskId.block(0), TaskId.block(1)
PLAN = PlanSaved("plan.json", (BlockPlan(0, 8, 100, train=True), BlockPlan(1, 4, 50, train=True)))


def test_before_anything_is_measured_the_order_is_that_of_cameras_times_gaussians() -> None:
    model = CostModel()
    assert model.seconds(3, 8, "any") > model.seconds(23, 1, "any") > model.seconds(2, 11, "any")
    assert fit([]) == model
    one = fit([BlockTime(10, 1_000, "fast", 50.0)])  # sets the scale and changes the order of nothing
    assert one.seconds(10, 1_000, "fast") == pytest.approx(50, rel=0.05)
    assert one.seconds(20, 1_000, "fast") > one.seconds(10, 1_000, "fast")


def test_the_exponents_are_learned() -> None:
    samples = [BlockTime(c, g, "fast", 0.01 * c**0.3 * g**0.5) for c, g in BLOCKS]
    model = fit(samples)
    assert model.cameras == pytest.approx(0.3, abs=0.05)
    assert model.gaussians == pytest.approx(0.5, abs=0.05)
    assert model.seconds(40, 10_000, "fast") == pytest.approx(0.01 * 40**0.3 * 10_000**0.5, rel=0.05)


def test_slower_places_are_found_out() -> None:
    samples = [BlockTime(c, g, "fast", 1e-3 * c * g) for c, g in BLOCKS]
    samples += [BlockTime(c, g, "slow", 3e-3 * c * g) for c, g in BLOCKS[:2]]
    model = fit(samples)
    ratio = model.seconds(9, 9_000, "slow") / model.seconds(9, 9_000, "fast")
    assert ratio == pytest.approx(3, rel=0.1)


def test_a_resumed_block_is_measured_by_what_its_last_attempt_did() -> None:
    done = after(PLAN, started(ZERO, 75, place="fast"), model(ZERO, 100, seconds=10.0))
    assert block_times(done) == [BlockTime(8, 100, "fast", 40.0)]
    resumed_at_its_end = after(PLAN, started(ZERO, 100, place="fast"), model(ZERO, 100, seconds=0.1))
    assert block_times(resumed_at_its_end) == []


def test_a_running_block_counts_once_it_is_well_on_its_way() -> None:
    resumed = started(ONE, 50, place="fast")
    assert block_times(after(PLAN, resumed, Progressed(ONE, 53, 100, rate=2.0))) == []
    later = after(PLAN, resumed, Progressed(ONE, 55, 100, rate=2.0))
    assert block_times(later) == [BlockTime(4, 50, "fast", 50.0)]


def test_what_a_running_task_still_needs() -> None:
    task = TaskState(ZERO, begun=50, progress=Progressed(ZERO, 60, 100, rate=4.0))
    assert seconds_left(task, predicted=99, running=1) == 10
    assert seconds_left(TaskState(ZERO), predicted=30, running=10) == 20
    assert seconds_left(TaskState(ZERO), predicted=30, running=50) == 0


# More machines


def table(*seconds: float, price: float | None = 1.0) -> Workers:
    rows = []
    for i, time in enumerate(seconds):
        hours = 2**i * time / 3600
        rows.append(WorkersRow(2**i, "auto", time, hours, None if price is None else hours * price))
    return Workers("kind", price, "USD" if price else "", tuple(rows))


@pytest.mark.parametrize(
    ("seconds", "knee"),
    [
        ((100, 50, 25, 12.5, 6.25), 16),  # as fast as could be
        ((100, 74, 60, 40, 20), 2),  # one doubling that hardly helps ends it
        ((100, 75, 56.25, 50, 49), 4),  # a quarter off is just enough
        ((100, 99, 98, 97, 96), 1),
        ((), None),
    ],
)
def test_the_knee_is_where_a_doubling_takes_less_than_a_quarter_off(
    seconds: tuple[float, ...], knee: int | None
) -> None:
    assert table(*seconds).knee == knee


def test_the_table_marks_the_knee_and_has_costs_only_with_a_price() -> None:
    lines = table(7200, 3600, 3500).lines()
    assert "1 USD per hour" in lines[0]
    assert ["save little time" in line for line in lines[2:]] == [False, True, False]
    assert table(7200, 7300).lines()[3].endswith("  no faster")
    assert "2.00" in lines[2]
    free = table(7200, 3600, price=None)
    assert "USD" not in "".join(free.lines())
    assert free.as_json()["rows"][0]["cost"] is None
    assert table().lines() == []
