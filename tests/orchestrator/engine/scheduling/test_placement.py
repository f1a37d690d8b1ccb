"""Which tasks start now and where, and which of them are assigned to which place."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.orchestrator.engine.scheduling.longest_first import assign_lpt
from panolog.orchestrator.engine.scheduling.placement import Demand, Running, largest, place
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement

GIB = 2**30
FAST, SLOW = Gpu("fast", 24 * GIB, "GPU-f"), Gpu("slow", 16 * GIB, "GPU-s")


def node(name: str = "a", *gpus: Gpu, cpus: int = 8, memory: int = 100 * GIB) -> Node:
    return Node(name, f"host-{name}", cpus, memory, gpus)


def lasting(seconds: float, slowness: float = 1.0) -> Callable[[str], float]:
    """Seconds by kind of place."""
    return lambda kind: seconds * (slowness if "slow" in kind else 1.0)


def block(name: str, seconds: float = 1.0, gib: float = 13, slowness: float = 1.0, **rest: object) -> Demand:
    """Args: name, which takes the place of a task; rest, as the fields of `Demand`."""
    return Demand(name, int(gib * GIB), lasting(seconds, slowness), **rest)  # type: ignore[arg-type]


def on_gpu(node: str, gpu: int, left: float = 1.0, gpus: float = 1.0, gib: float = 20) -> Running:
    return Running(Placement(node, 1.0, int(gib * GIB), gpus, gpu), left)


def placed(
    requests: list[Demand], nodes: list[Node], *running: Running, cuda: bool = True
) -> dict[str, Placement]:
    return {str(task): where for task, where in place(requests, nodes, running, cuda=cuda)}


def where(requests: list[Demand], nodes: list[Node], *running: Running) -> dict[str, tuple[str, int | None]]:
    return {task: (at.node, at.gpu) for task, at in placed(requests, nodes, *running).items()}


def cores(requests: list[Demand], nodes: list[Node], *running: Running) -> dict[str, tuple[str, int]]:
    found = placed(requests, nodes, *running, cuda=False)
    return {task: (place.node, place.threads) for task, place in found.items()}


def on_cpu(node: str, cpus: int, gib: float = 1) -> Running:
    return Running(Placement(node, float(cpus), int(gib * GIB)), 1.0)


# On GPUs


def test_the_longest_start_first_and_the_rest_waits() -> None:
    blocks = [block("short", 1), block("long", 9), block("middle", 5)]
    assert where(blocks, [node("a", SLOW), node("b", SLOW)]) == {"long": ("a", 0), "middle": ("b", 0)}
    assert where(blocks, [node("a", SLOW)], on_gpu("a", 0)) == {}
    assert where(blocks, []) == {}


def test_a_free_gpu_is_used_whatever_the_others_do() -> None:
    nodes = [node("a", SLOW, SLOW), node("b", SLOW)]
    assert where([block("one")], nodes, on_gpu("a", 0), on_gpu("b", 0)) == {"one": ("a", 1)}


def test_the_longest_gets_the_fastest_and_a_slow_gpu_stays_free_where_a_busy_one_will_be_done_sooner() -> (
    None
):
    nodes = [node("a", SLOW, FAST)]
    blocks = [block("short", 2, slowness=2), block("long", 3, slowness=2)]
    assert where(blocks, nodes) == {"long": ("a", 1), "short": ("a", 0)}
    last = [block("last", 10, slowness=5)]
    assert where(last, nodes, on_gpu("a", 1, left=20)) == {}
    assert where(last, nodes, on_gpu("a", 1, left=45)) == {"last": ("a", 0)}
    assert where(last, nodes) == {"last": ("a", 1)}


def test_a_block_goes_where_it_fits_or_where_memory_is_unknown() -> None:
    blocks = [block("large", 1, gib=20), block("small", 9, gib=10)]
    assert where(blocks, [node("a", SLOW, SLOW), node("b", FAST)]) == {"large": ("b", 0), "small": ("a", 0)}
    assert where(blocks, [node("a", Gpu(), Gpu())]) == {"small": ("a", 0), "large": ("a", 1)}


def test_small_blocks_share_a_gpu_once_each_gpu_has_one() -> None:
    small = [block(f"{i}", 10 - i, gib=6) for i in range(9)]
    found = placed(small, [node("a", FAST, FAST)])
    assert [(task, p.gpu, p.gpus, p.memory, p.cpus) for task, p in found.items()] == [
        (str(i), i % 2, 0.25, 6 * GIB, 1.0) for i in range(8)
    ]
    assert {p.kind for p in found.values()} == {"1/4 fast"}
    tiny = [block(str(i), gib=0.5) for i in range(9)]
    assert len(placed(tiny, [node("a", FAST)])) == 4  # no more share one


def test_a_gpu_that_has_room_for_one_more_takes_one_more() -> None:
    half = on_gpu("a", 0, gpus=0.5)
    assert where([block("x", gib=10), block("y", gib=10)], [node("a", FAST)], half) == {"x": ("a", 0)}
    assert where([block("x", gib=13)], [node("a", FAST)], half) == {}


@pytest.mark.parametrize("cuda", [True, False])
def test_what_seems_too_large_for_all_gets_the_largest_to_itself(cuda: bool) -> None:
    nodes = [node("a", SLOW, memory=10 * GIB), node("b", FAST, memory=20 * GIB)]
    requests = [block("huge", gib=99), block("other", gib=5)]
    found = placed(requests, nodes, cuda=cuda)
    assert {task: place.node for task, place in found.items()} == {"huge": "b", "other": "a"}
    assert found["huge"].memory == largest(nodes, cuda=cuda)


def test_who_ran_out_of_memory_gets_a_gpu_to_itself_and_others_keep_off_it() -> None:
    nodes = [node("a", FAST), node("b", FAST)]
    hungry, others = block("hungry", gib=5, alone=True), [block("x", gib=5), block("y", gib=5)]
    quarter = on_gpu("a", 0, left=5, gpus=0.25), on_gpu("b", 0, left=3, gpus=0.25)
    assert where([*others, hungry], nodes, *quarter) == {"x": ("a", 0), "y": ("a", 0)}  # b is being emptied
    assert where([hungry], nodes, quarter[0]) == {"hungry": ("b", 0)}
    assert placed([hungry], nodes, quarter[0])["hungry"].gpus == 1


def test_who_ran_out_of_memory_again_gets_a_larger_gpu() -> None:
    nodes = [node("a", SLOW, SLOW), node("b", FAST)]
    again = block("again", gib=5, alone=True, more_than=16 * GIB)
    assert where([again], nodes) == {"again": ("b", 0)}
    assert where([again], nodes, on_gpu("b", 0)) == {}
    assert where([again], nodes[:1]) == {"again": ("a", 0)}  # the larger one is gone: better than never


def test_gpus_are_shared_only_by_more_tasks_than_there_are_gpus() -> None:
    two, three = ([block(str(i), gib=2) for i in range(count)] for count in (2, 3))
    assert [p.kind for p in placed(two, [node("a", FAST, FAST)]).values()] == ["fast", "fast"]
    assert [p.gpus for p in placed(three, [node("a", FAST, FAST)]).values()] == [0.5] * 3


def test_no_whole_gpu_is_planned_where_parts_are_taken() -> None:
    """Ray may have put these on any GPU of the node."""
    part = on_gpu("a", 0, gpus=0.25)
    (place,) = placed([block("x", gib=2)], [node("a", FAST, FAST)], part).values()
    assert (place.gpu, place.gpus) == (1, 0.25)


def test_a_gpu_is_pinned_only_where_they_differ() -> None:
    def pinned(machine: Node) -> tuple[str, bool]:
        (found,) = placed([block("x")], [machine]).values()
        return found.uuid, found.pinned

    assert pinned(node("a", SLOW, FAST)) == ("GPU-s", True)
    assert pinned(node("a", FAST, FAST)) == ("GPU-f", False)
    assert pinned(replace(node("a", FAST, FAST), closed=(1,))) == ("GPU-f", True)
    assert not pinned(node("a", FAST, Gpu("fast", 24 * GIB - 2**20, "GPU-e")))[1]
    assert pinned(node("a", FAST, Gpu("fast", 22 * GIB, "GPU-e")))[1]


def test_no_task_gets_a_gpu_that_is_in_quarantine() -> None:
    tasks = [block(str(i), gib=20) for i in range(3)]
    machine = replace(node("a", FAST, FAST), closed=(0,))
    assert where(tasks, [machine]) == {"0": ("a", 1)}


def test_cores_go_with_gpus() -> None:
    many = [block(str(i), gib=20) for i in range(3)]
    assert [p.cpus for p in placed(many, [node("a", FAST, FAST, FAST, cpus=8)]).values()] == [2.0] * 3
    few = placed(many, [node("a", FAST, FAST, FAST, cpus=2)])
    assert [(p.cpus, p.threads) for p in few.values()] == [(0.6666, 1)] * 3


# On CPUs


@pytest.mark.parametrize(
    ("tasks", "cpus", "fit", "threads"),
    [
        (1, 2, 9, [2]),
        (2, 2, 9, [1, 1]),
        (3, 2, 9, [1, 1]),
        (3, 16, 9, [6, 5, 5]),
        (9, 4, 9, [1] * 4),
        (4, 16, 2, [8, 8]),
        (5, 4, 1, [4]),
    ],
)
def test_cores_are_shared_as_far_as_memory_goes(tasks: int, cpus: int, fit: int, threads: list[int]) -> None:
    machine = node("a", cpus=cpus, memory=int(fit * GIB / 0.9) + 1)
    found = cores([block(str(i), gib=1) for i in range(tasks)], [machine])
    assert found == {str(i): ("a", count) for i, count in enumerate(threads)}


def test_tasks_spread_over_the_nodes() -> None:
    nodes = [node("a", cpus=4), node("b", cpus=2), node("c", cpus=0)]
    assert cores([block("x"), block("y"), block("z")], nodes) == {"x": ("a", 2), "y": ("a", 2), "z": ("b", 2)}


def test_thousands_of_tasks_are_not_compared_with_each_of_thousands_of_nodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks, plain = 0, Demand.avoids

    def counted(demand: Demand, device: Any) -> float:
        nonlocal looks
        looks += 1
        return plain(demand, device)

    monkeypatch.setattr(Demand, "avoids", counted)
    nodes = [node(str(i), cpus=1 + i % 2, memory=(4 + i % 5) * GIB) for i in range(300)]
    blocks = [block(str(i), seconds=i, gib=i % 7) for i in range(1000)]
    assert len(placed(blocks, nodes, cuda=False)) > 300
    assert looks < len(blocks)


def test_what_runs_keeps_its_cores_and_memory() -> None:
    nodes = [node("a", cpus=4, memory=10 * GIB)]
    assert cores([block("x", gib=1)], nodes, on_cpu("a", 3)) == {"x": ("a", 1)}
    assert cores([block("x", gib=1)], nodes, on_cpu("a", 4)) == {}
    assert cores([block("x", gib=5), block("y", gib=1)], nodes, on_cpu("a", 2, gib=7)) == {"y": ("a", 2)}


def test_a_node_is_given_to_one_alone_that_ran_out_of_memory() -> None:
    nodes = [node("a", cpus=4), node("b", cpus=4)]
    hungry = block("hungry", gib=1, alone=True)
    assert cores([hungry, block("x", gib=1)], nodes) == {"hungry": ("a", 4), "x": ("b", 4)}
    assert cores([hungry, block("x", gib=1)], nodes[:1], on_cpu("a", 1)) == {}


# Nodes on which a task has failed


def test_a_task_avoids_the_node_on_which_it_has_failed_and_waits_a_little_for_another() -> None:
    nodes = [node("a", SLOW), node("b", SLOW)]
    one = block("one", 9, avoid={"a": 1})
    assert where([one, block("two")], nodes) == {"one": ("b", 0), "two": ("a", 0)}
    assert where([block("one", alone=True, avoid={"a": 1})], nodes) == {"one": ("b", 0)}
    assert where([one], nodes, on_gpu("b", 0, left=500)) == {}
    assert where([one], nodes, on_gpu("b", 0, left=5_000)) == {"one": ("a", 0)}
    assert where([one], nodes[:1]) == {"one": ("a", 0)}
    everywhere = block("one", avoid={"a": 1, "b": 1})
    assert where([everywhere], nodes, on_gpu("b", 0, left=5)) == {"one": ("a", 0)}


def test_where_it_has_failed_everywhere_a_task_starts_where_it_did_so_least() -> None:
    gpus, cpus = [node("a", SLOW), node("b", SLOW)], [node("a", cpus=2), node("b", cpus=2)]
    one = block("one", gib=1, avoid={"a": 2, "b": 1})
    assert where([one], gpus) == {"one": ("b", 0)}
    assert cores([one], cpus) == {"one": ("b", 2)}
    assert cores([one], cpus, on_cpu("b", 2)) == {}


def test_on_cpus_a_task_avoids_a_node_too() -> None:
    nodes = [node("a", cpus=8), node("b", cpus=2)]
    one = block("one", gib=1, avoid={"a": 1})
    assert cores([one], nodes) == {"one": ("b", 2)}
    assert cores([one], nodes, on_cpu("b", 2)) == {}
    long = Running(Placement("b", 2.0, GIB), 5_000.0)
    assert cores([one], nodes, long) == {"one": ("a", 8)}
    assert cores([one], nodes[:1]) == {"one": ("a", 8)}


# Assignment


def end_of(seconds: NDArray[np.float64], free_in: NDArray[np.float64], slot_of: NDArray[np.int64]) -> float:
    load = free_in.copy()
    np.add.at(load, slot_of, seconds[np.arange(len(seconds)), slot_of])
    return float(load.max())


def unequal(tasks: int, slots: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.default_rng(seed)
    seconds = random.uniform(1, 5, (tasks, 1)) * random.uniform(1, 3, slots)
    return seconds, random.uniform(0, 4, slots)


def test_the_last_end_is_hardly_later_than_the_best_of_all() -> None:
    excess = []
    for seed in range(20):
        seconds, free_in = unequal(6, 3, seed)
        best = min(end_of(seconds, free_in, np.array(ways)) for ways in product(range(3), repeat=6))
        excess.append(end_of(seconds, free_in, assign_lpt(seconds, free_in)) / best - 1)
    assert min(excess) >= 0
    assert np.mean(excess) < 0.01
    assert max(excess) < 0.1


def test_no_task_lands_where_it_cannot_run() -> None:
    seconds, free_in = unequal(30, 4, seed=0)
    seconds[::2, 1:] = np.inf
    slot_of = assign_lpt(seconds, free_in)
    assert np.isfinite(seconds[np.arange(30), slot_of]).all()
    assert (slot_of[::2] == 0).all()


def test_nothing_to_deal() -> None:
    assert assign_lpt(np.empty((0, 2)), np.zeros(2)).tolist() == []
