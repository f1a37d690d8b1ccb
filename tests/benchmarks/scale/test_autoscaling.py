from dataclasses import replace

import pytest

from benchmarks.scale.autoscaling import Case, Simulation, city_case, measure, recorded_cases
from benchmarks.scheduling import Block
from panolog.orchestrator.resources.scaling import IDLE_S

pytestmark = pytest.mark.system

RECORDED = {case.name: case for case in recorded_cases([10, 120])}


@pytest.mark.parametrize("case", RECORDED)
def test_recorded_runs_take_machine_hours_near_those_of_the_work(case: str) -> None:
    row = measure(RECORDED[case], most=16, overhead=0.1, seeds=1)
    assert 1 <= row.ratio <= 1.15
    assert row.ratio < row.always


def test_so_do_cities() -> None:
    row = measure(city_case(300), most=16, overhead=0.1, seeds=1)
    assert 1 <= row.ratio <= 1.15
    assert row.seconds < row.one


def test_without_an_overhead_there_is_one_machine_and_with_much_there_are_all() -> None:
    case = Case("four hours", (3600.0,), (Block(1, 1, 3600.0),) * 4)
    seconds, machines, most = Simulation(case, 16, 0.0, seed=0).run()
    assert most == 1
    assert seconds == pytest.approx(case.work + 120 + 30, abs=2 * 330)  # two starts of five minutes at most
    assert machines == pytest.approx(case.work, abs=2 * (330 + IDLE_S) + 150)
    sooner, _, most = Simulation(case, 16, 100.0, seed=0).run()
    assert most == 4
    assert sooner < seconds - 2.5 * 3600


def test_a_machine_costs_from_its_request_to_the_end_of_its_idle_minute() -> None:
    case = replace(Case("one task", (600.0,), ()), merge=0.0, evaluation=5.0)
    _, machines, most = Simulation(case, 1, 0.1, seed=0).run()
    assert most == 1
    assert 600 + 60 + IDLE_S < machines < 600 + 2 * (300 + IDLE_S + 30)
