"""A bad node gets no more tasks, and its failures do not count against them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.engine.driver.attempts import Attempt
from panolog.orchestrator.engine.scheduling import quarantine
from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.config import QuarantineConfig
from panolog.orchestrator.runs.machines.nodes import Gpu, Node, Placement
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    Failure,
    NodeQuarantined,
    NodeReleased,
    Outcome,
    PlanSaved,
    Record,
    RunEnded,
    RunWaiting,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.runs.state import RunState, Status, apply, replay
from panolog.scene.errors import RunError
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Progress, Stage, TaskId
from tests.orchestrator.fakes import CrashError, FakePool, Harness, Script, SetClock, well
from tests.orchestrator.history import AGAIN, after, started
from tests.orchestrator.scripted import Works

A, B = Node("aaaa", "gpu-a", 2, 2**40), Node("bbbb", "gpu-b", 2, 2**40)
CARDS = tuple(Gpu("NVIDIA L4", 22 * 2**30, f"GPU-{number}") for number in range(4))
FOUR = Node("ffff", "gpu-f", 32, 2**40, CARDS)
CONFIG = QuarantineConfig(failures=3, seconds=60)
PLAN = PlanSaved("plan.json", tuple(BlockPlan(block, 4, 100, train=True) for block in range(9)))
BLOCKS = [TaskId.block(block) for block in range(9)]


def failed(
    task: TaskId, node: Node, reason: str = "", kind: Failure = Failure.ERROR, gpu: int | None = None
) -> TaskFailed:
    """By default each task fails in a way of its own."""
    card = "" if gpu is None else node.card(gpu)
    return TaskFailed(task, 1, reason or f"{task}: no", final=False, kind=kind, node=node.id, card=card)


def run(*records: Record, nodes: tuple[Node, ...] = (A, B)) -> RunState:
    """The state after records, one a second from 0 on, and after what follows from each."""
    state = replay([Stored(0, 0.0, PLAN)])
    for second, record in enumerate(records):
        state = apply(state, [Stored(0, float(second), record)])
        state = review(state, float(second), nodes)
    return state


def review(state: RunState, now: float, nodes: tuple[Node, ...] = (A, B)) -> RunState:
    for change in quarantine.changes(state, nodes, CONFIG, now):
        state = apply(state, [Stored(0, now, change)])
    return state


def fails(*tasks: int, node: Node = A, **rest: Any) -> list[Record]:
    return [failed(BLOCKS[task], node, **rest) for task in tasks]


def saves(node: Node, card: str = "") -> list[Record]:
    return [replace(started(BLOCKS[8], node=node.id), card=card), CheckpointSaved(BLOCKS[8], 5, "c", 1)]


def bad(state: RunState) -> list[str]:
    return [node.host for node in state.quarantined()]


THREE, ON_ONE = fails(0, 1, 2), fails(0, 1, 2, node=FOUR, gpu=3)
ALIKE = [failed(task, A, f"no card {task.number}") for task in BLOCKS[:3]]
UNLIKE = [failed(task, A, why) for task, why in zip(BLOCKS, ("file", "memory", "card"), strict=False)]
EACH = [failed(task, FOUR, "no driver", gpu=task.number) for task in BLOCKS[:3]]
ENDED = RunEnded(Outcome.FAILED, "no")
REPEATED = [*fails(0), *fails(0, node=B), *fails(1, 2)]


@pytest.mark.parametrize(
    ("nodes", "records", "places"),
    [
        pytest.param((A, B), THREE[:2], [], id="two tasks are too few"),
        pytest.param((A, B), fails(0, 0, 0, 0, 0), [], id="one task may be the cause"),
        pytest.param((A, B), fails(*range(9), kind=Failure.MEMORY), [], id="a shortage is of no node"),
        pytest.param((A, B), [*THREE[:2], *saves(A), THREE[2]], [], id="a success clears a node"),
        pytest.param((A, B), [*THREE[:2], *saves(B), THREE[2]], ["gpu-a"], id="but not one elsewhere"),
        pytest.param((A,), UNLIKE, [], id="the only node may be used while tasks fail differently"),
        pytest.param((A,), ALIKE[:2], [], id="or two alike"),
        pytest.param((A,), ALIKE, ["gpu-a"], id="not where all do"),
        pytest.param((A, FOUR), EACH, ["gpu-f"], id="failures on several GPUs are of their node"),
        pytest.param((FOUR,), EACH, ["gpu-f"], id="also of the only one where they are alike"),
        pytest.param(
            (FOUR,),
            [*ON_ONE[:2], *saves(FOUR, "GPU-0"), ON_ONE[2]],
            ["gpu-f, GPU 3"],
            id="a success on another GPU does not clear a bad one",
        ),
        pytest.param((FOUR,), [*ON_ONE, *EACH[:1]], ["gpu-f, GPU 3"], id="its failures are not the node's"),
        pytest.param((A, FOUR), [*ON_ONE, *EACH[:1]], ["gpu-f, GPU 3"], id="also next to another node"),
        pytest.param((A, B), [*saves(B), *REPEATED], [], id="a task that fails alike on a sound node"),
        pytest.param((A, B), REPEATED, ["gpu-a"], id="of the other nothing good is known"),
        pytest.param((A, B), [*THREE, *saves(B), *fails(2, node=B)], [], id="found out after the quarantine"),
        pytest.param((A, B), [*THREE, AGAIN], ["gpu-a"], id="a new driver knows of it"),
        pytest.param((A, B), [*THREE, ENDED, AGAIN], [], id="unless the run had failed"),
        pytest.param((A, B), [*THREE[:2], AGAIN, THREE[2]], [], id="but not of single failures"),
    ],
)
def test_failures_of_different_tasks_put_a_place_into_quarantine(
    nodes: tuple[Node, ...], records: list[Record], places: list[str]
) -> None:
    assert bad(run(*records, nodes=nodes)) == places


def test_a_quarantine_has_its_reason_and_ends_after_its_time() -> None:
    state = run(*THREE)
    (node,) = state.quarantined()
    assert (node.host, node.until) == ("gpu-a", 62.0)
    assert node.reason == "3 tasks have failed there in a row, the last one, block/002: block/002: no"
    assert [node.host for node in quarantine.usable(state, (A, B))] == ["gpu-b"]
    assert [notice.message for notice in state.notices] == [f"gpu-a (aaaa) is in quarantine: {node.reason}"]
    assert bad(review(state, 61.0)) == ["gpu-a"]
    assert bad(review(state, 62.0)) == []
    assert bad(review(state, -1000.0)) == []  # the clock was set back
    assert bad(review(review(state, 62.0), 63.0)) == []  # its old failures are forgotten


@pytest.mark.parametrize("nodes", [(FOUR,), (A, FOUR)], ids=["the only node", "one of two"])
def test_a_gpu_is_put_into_quarantine_alone(nodes: tuple[Node, ...]) -> None:
    state = run(*ON_ONE, nodes=nodes)
    assert [(card.id, card.host) for card in state.quarantined()] == [("GPU-3", "gpu-f, GPU 3")]
    assert quarantine.usable(state, [FOUR])[0].closed == (3,)
    assert quarantine.excuses(state, (FOUR.id, "GPU-3"), Failure.ERROR)
    assert not quarantine.excuses(state, (FOUR.id, "GPU-2"), Failure.ERROR)


def test_failures_on_a_bad_node_do_not_count_against_its_tasks() -> None:
    lost = fails(1, kind=Failure.LOST)
    final = TaskFailed(BLOCKS[2], 3, "block/002: no", final=True, node=A.id)
    before = after(PLAN, *fails(0, node=B), *fails(0), *lost, final)
    state = review(before, 1.0)
    for found, counts in ((before, [(2, 0), (0, 1), (1, 0)]), (state, [(1, 0), (0, 0), (0, 0)])):
        assert [(found.task(task).errors, found.task(task).losses) for task in BLOCKS[:3]] == counts
    assert (before.status(BLOCKS[2]), state.status(BLOCKS[2])) == (Status.FAILED, Status.WAITING)
    assert quarantine.excuses(state, (A.id, ""), Failure.LOST)
    assert not quarantine.excuses(state, (A.id, ""), Failure.MEMORY)
    assert not quarantine.excuses(state, (B.id, ""), Failure.LOST)
    spec: Any = Works(task=BLOCKS[3])
    for node in (A, B):
        attempt = Attempt(spec, 1, 0, Placement(node.id, 1.0, 2**30), latest=0.0)
        record = attempt.failed(Failed("no"), state, (A, B), RunConfig(retries=0))
        assert (record.excused, record.final) == (node is A, node is B)


# With the driver


def breaks_on(node: Node, harness: Harness) -> Script:
    """All tasks fail on a node, each with the same words."""

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if harness.pool.placement(spec.task).node == node.id:
            raise CrashError(Failed(f"{spec.task}: CUDA error: uncorrectable ECC error"))
        yield from well(spec)

    return script


@pytest.fixture
def many(tmp_path: Path) -> Harness:
    """A run of eight blocks on two nodes, of which the worse has more cores."""
    nodes = (Node(A.id, A.host, 4, 2**40), Node(B.id, B.host, 1, 2**40))
    return Harness(tmp_path, nodes, blocks="4x2x1", retries=0)


def test_one_broken_gpu_does_not_eat_the_run_of_the_only_machine(tmp_path: Path) -> None:
    harness = Harness(tmp_path, (FOUR,), device="cuda", blocks="4x4x1", partition={"min_cameras": 1})
    harness.clock = SetClock()

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if spec.task.stage is Stage.BLOCK:
            if harness.pool.placement(spec.task).gpu == 3:
                raise CrashError(Failed("AcceleratorError: CUDA error: unspecified launch failure"))
            for step in range(50):  # so that the broken one is always free first
                yield Progress(spec.task, step, 50, 3.0)
        yield from well(spec)

    assert harness.drive(script).outcome == "done"
    (quarantined,) = harness.records(NodeQuarantined)
    assert (quarantined.node, quarantined.host) == ("GPU-3", "gpu-f, GPU 3")
    assert {(failed.card, failed.final) for failed in harness.records(TaskFailed)} == {("GPU-3", False)}
    assert 3 <= len(harness.records(TaskFailed)) <= 4  # of the tasks on its four parts


def test_a_failure_counts_on_the_gpu_that_the_worker_reports(tmp_path: Path) -> None:
    """On a cluster Ray may have picked another one."""
    harness = Harness(tmp_path, (FOUR,), device="cuda")

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if spec.task == COARSE and not harness.records(TaskFailed):
            raise CrashError(Failed("CUDA error"))
        yield from well(spec)

    pool = FakePool(script, (FOUR,))
    pool.card = "GPU-2"
    assert harness.drive(pool=pool).outcome == "done"
    assert [failed.card for failed in harness.records(TaskFailed)] == ["GPU-2"]
    first, again = (where.gpu for where, _ in harness.attempts(COARSE))
    assert first != 2 != again
    assert {begun.card for begun in harness.records(TaskStarted)} == {"GPU-2"}


def test_what_fails_everywhere_on_the_only_machine_pauses_the_run(
    tmp_path: Path,
) -> None:
    harness = Harness(tmp_path, (FOUR,), device="cuda", blocks="4x2x1", retries=1)
    harness.clock = clock = SetClock()
    broken = [True]

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        harness.pool.when_waiting(lambda: clock.sleep(60))
        broken[0] = broken[0] and len(harness.records(NodeReleased)) == 0
        if spec.task.stage is Stage.BLOCK and broken[0]:
            raise CrashError(Failed(f"RuntimeError: error {spec.task.number}: no kernel image"))
        yield from well(spec)

    assert harness.drive(script).outcome == "done"
    assert 600 <= clock.now - 1e9 < 1200
    assert any("the run waits" in notice.message for notice in harness.state.notices)


def test_a_worker_that_is_killed_on_the_sound_node_leaves_no_only_choice(tmp_path: Path) -> None:
    """Both nodes then have a failure: the task goes to the one with fewer and with lesser ones."""
    harness = Harness(tmp_path, (A, B))
    on_a, kills = breaks_on(A, harness), iter([COARSE])

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if harness.pool.placement(spec.task).node == B.id and next(kills, None) == spec.task:
            raise CrashError(Failed("killed", Failure.LOST))
        yield from on_a(spec)

    assert harness.drive(script).outcome == "done"
    assert [where.node for where, _ in harness.attempts(COARSE)] == [A.id, B.id, B.id]


def test_where_all_nodes_fail_the_run_waits_and_then_says_why(many: Harness) -> None:
    many.clock = clock = SetClock()

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        many.pool.when_waiting(lambda: clock.sleep(60))
        if spec.task.stage is Stage.BLOCK:
            raise CrashError(Failed(f"{many.pool.placement(spec.task).node}: no"))
        yield from well(spec)

    with pytest.raises(RunError, match="every machine is in quarantine"):
        many.drive(script)
    assert len(many.records(NodeQuarantined)) == 12
    assert {released.reason for released in many.records(NodeReleased)} == {"its time is over"}
    assert 5 * 600 <= clock.now - 1e9 < 2 * 3600
    assert many.state.failed_blocks() == ()  # none is given up
    waits = many.records(RunWaiting)
    assert all(wait.reason.startswith("waiting: every machine is in quarantine; gpu-") for wait in waits)
    assert len(waits) == 5  # of six rounds, after the last of which it gives up
    assert any("all are used again after 10:00" in notice.message for notice in many.state.notices)
    assert many.drive(resumed=True).outcome == "done"
