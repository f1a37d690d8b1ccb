"""How many machines a stage gets, from which group, and which of those requested still count."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace

import pytest

from panolog.orchestrator.engine.scheduling import placement
from panolog.orchestrator.engine.scheduling.expected import Coming, Expected
from panolog.orchestrator.engine.scheduling.placement import Demand, Running
from panolog.orchestrator.engine.scheduling.scaling import IDLE_S, STARTUP_S, Group, Growth, Scaling, Work
from panolog.orchestrator.runs.machines.config import ScalingConfig
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.workers.tasks import TaskId
from tests.orchestrator.fakes import SetClock

GIB = 2**30
SMALL = Group("small", most=8, cpus=8, gpus=1, accelerator="L4", memory=64 * GIB)
LARGE = Group("large", most=2, cpus=16, gpus=1, accelerator="H100", memory=128 * GIB)
HOUR = 3600.0


def node(name: str, memory: int = 22, model: str = "NVIDIA L4") -> Node:
    return Node(name, name, 8, 64 * GIB, (Gpu(model, memory * GIB),))


def work(count: int, seconds: float, memory: int = 12, whole: float = 100 * HOUR) -> Work:
    demands = [Demand(TaskId.block(i), memory * GIB) for i in range(count)]
    return Work(demands, [seconds] * count, whole)


def on(machine: Node, left: float) -> Running:
    return Running(Placement(machine.id, 8, 22 * GIB, 1.0, 0), left)


def scaling(
    groups: Sequence[Group] = (SMALL,),
    members: Mapping[str, str] | None = None,
    overhead: float = 0.1,
    joining: int = 0,
    **prices: float,
) -> Scaling:
    def price(machine: Node) -> float | None:
        return prices.get(machine.id.split()[0])

    return Scaling(Growth(tuple(groups), members or {}, joining), True, overhead, price=price)


def test_a_stage_of_many_hours_gets_all_machines_that_shorten_it_and_no_others() -> None:
    assert scaling().wanted(work(8, HOUR), (), ()) == {"small": 8}
    assert scaling().wanted(work(3, HOUR), (), ()) == {"small": 3}
    uneven = replace(work(4, HOUR, whole=7 * HOUR), seconds=[4 * HOUR, HOUR, HOUR, HOUR])
    assert scaling().wanted(uneven, (), ()) == {"small": 2}


@pytest.mark.parametrize(("hours", "count"), [(0.1, 1), (1, 1), (2, 3), (5, 7)])
def test_the_starts_of_machines_cost_a_tenth_of_the_work_at_most(hours: float, count: int) -> None:
    found = scaling().wanted(work(40, hours * HOUR / 40, whole=hours * HOUR), (), ())
    assert found == {"small": count}
    assert count == 1 or count * (STARTUP_S + IDLE_S) <= 0.1 * hours * HOUR


@pytest.mark.parametrize(
    ("there", "left", "joining", "tasks", "wanted"),
    [
        (2, HOUR, 0, 2, {"small": 2}),
        (2, 0, 0, 2, {}),  # they are free
        (2, HOUR, 2, 2, {}),
        (1, 60, 0, 1, {}),  # it is free sooner than a new one would be
        (7, HOUR, 0, 8, {"small": 1}),  # the group has no more
    ],
)
def test_those_that_are_there_or_joining_count(
    there: int, left: float, joining: int, tasks: int, wanted: dict[str, int]
) -> None:
    nodes = [node(str(i)) for i in range(there)]
    members, busy = {machine.id: "small" for machine in nodes}, [on(m, left) for m in nodes if left]
    assert scaling(members=members, joining=joining).wanted(work(tasks, HOUR), busy, nodes) == wanted


def test_a_task_that_fits_on_nothing_there_gets_a_larger_machine() -> None:
    there = [node("a")]
    assert scaling([SMALL, LARGE]).wanted(work(1, 60, memory=40), (), there) == {"large": 1}
    assert scaling([SMALL, LARGE]).wanted(work(1, 60, memory=12), (), there) == {}
    assert scaling([LARGE, SMALL]).wanted(work(1, HOUR), (), ()) == {"small": 1}  # no price: the smallest


def test_the_cheapest_group_that_fits_is_taken_and_then_the_next() -> None:
    spot, demand = Group("spot", 2, 8, 1, "L4"), Group("demand", 8, 8, 1, "L4")
    found = scaling([demand, spot], spot=0.4, demand=1.2).wanted(work(4, HOUR), (), ())
    assert found == {"spot": 2, "demand": 2}
    assert list(found) == ["spot", "demand"]
    later = scaling([demand, spot], spot=0.4, demand=1.2)
    assert later.wanted(work(4, HOUR), (), (), without={"spot"}) == {"demand": 4}
    assert later.wanted(work(4, HOUR), (), (), without={"spot", "demand"}) == found


def test_groups_without_what_tasks_need_are_none() -> None:
    cores = Group("cores", 8, 8)
    assert scaling([cores]).wanted(work(1, HOUR), (), ()) == {}
    assert Scaling(Growth((cores,)), False, 0.1).wanted(work(1, HOUR), (), ()) == {"cores": 1}


def test_what_could_come_is_what_pays() -> None:
    there = [node("a")]
    assert len(scaling().potential(12 * GIB, 5 * HOUR, there)) == 7
    assert len(scaling().potential(12 * GIB, 0.1 * HOUR, there)) == 1
    assert [m.id for m in scaling().potential(12 * GIB, 0.1 * HOUR, [])] == ["small 0"]


def decide(
    expected: Expected, growth: Growth, tasks: Work, nodes: Sequence[Node] = (), patience: float = 600
) -> Coming:
    settings = ScalingConfig(overhead=0.1, patience=patience)
    return expected.decide(growth, tasks, (), nodes, settings, lambda _: None, cuda=True)


def test_tasks_wait_for_a_large_machine_that_is_coming_but_not_for_ever() -> None:
    clock, there = SetClock(), [node("a")]
    expected, tasks = Expected(clock), work(1, HOUR, memory=40)
    come = decide(expected, Growth((LARGE,)), tasks, there)
    assert (come.wanted, come.more) == ({"large": 1}, {"large": 1})

    def placed(come: Coming) -> list[str]:
        found = placement.place(tasks.demands, [*there, *come.nodes], come.fill, cuda=True)
        return [where.node for _, where in found]

    assert placed(come) == []
    clock.now += 599
    again = decide(expected, Growth((LARGE,)), tasks, there)
    assert (again.wanted, again.more) == ({"large": 1}, {})
    assert placed(again) == []
    clock.now += 2
    assert placed(decide(expected, Growth((LARGE,)), tasks, there)) == ["a"]


def test_how_long_machines_take_is_learnt() -> None:
    clock = SetClock()
    expected = Expected(clock)
    decide(expected, Growth((SMALL,)), work(2, HOUR))
    clock.now += 60
    growth = Growth((SMALL,), {"a": "small", "b": "small"})
    decide(expected, growth, work(0, HOUR), [node("a"), node("b")])
    assert expected.startup == pytest.approx((2 * STARTUP_S + 120) / 4)
    assert not expected.since


def test_a_group_that_gives_none_is_replaced_by_the_next_until_it_gives_one_or_for_half_an_hour() -> None:
    clock = SetClock()
    expected, growth = Expected(clock), Growth((SMALL, LARGE))
    assert decide(expected, growth, work(1, HOUR)).wanted == {"small": 1}
    clock.now += 601
    assert decide(expected, growth, work(1, HOUR)).wanted == {"large": 1}
    clock.now += 10
    assert decide(expected, growth, work(1, HOUR)).wanted == {"large": 1}
    again = deepcopy(expected), Growth((SMALL, LARGE), {"a": "small"})  # it gives one again
    assert decide(*again, work(4, HOUR)).wanted == {"small": 4}
    clock.now += 1800
    assert decide(expected, growth, work(1, HOUR)).wanted == {"small": 1}
    assert decide(expected, growth, Work((), ())).wanted == {}
    assert not expected.since
