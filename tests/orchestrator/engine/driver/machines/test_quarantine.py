"""A bad node gets no more tasks, and its failures do not count against them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from panolog.orchestrator.engine.scheduling import quarantine
from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs.machines.config import QuarantineConfig
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
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
from panolog.workers.events import Calibration, Event, Progress
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Stage, TaskId
from tests.orchestrator.fakes import CrashError, FakePool, Harness, Script, SetClock, well
from tests.orchestrator.history import AGAIN, after, model, started

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
    """The state after it was decided which nodes are in quarantine."""
    for change in quarantine.changes(state, nodes, CONFIG, now):
        state = apply(state, [Stored(0, now, change)])
    return state


def bad(state: RunState) -> list[str]:
    return [node.host for node in state.quarantined()]


def test_failures_of_different_tasks_put_a_node_into_quarantine() -> None:
    assert bad(run(failed(BLOCKS[0], A), failed(BLOCKS[1], A))) == []
    assert bad(run(*[failed(BLOCKS[0], A)] * 5)) == []  # one task may be the cause
    assert bad(run(*(failed(task, A, kind=Failure.MEMORY) for task in BLOCKS))) == []
    state = run(*(failed(task, A) for task in BLOCKS[:3]))
    (node,) = state.quarantined()
    assert (node.host, node.until) == ("gpu-a", 62.0)
    assert node.reason == "3 tasks have failed there in a row, the last one, block/002: block/002: no"
    assert [node.host for node in quarantine.usable(state, (A, B))] == ["gpu-b"]
    assert [notice.message for notice in state.notices] == [f"gpu-a (aaaa) is in quarantine: {node.reason}"]


def test_the_only_node_is_not_used_for_a_while_where_tasks_fail_alike() -> None:
    ways = ["no file", "no memory", "no card"]
    different = [failed(task, A, why) for task, why in zip(BLOCKS, ways, strict=False)]
    assert bad(run(*different, nodes=(A,))) == []
    alike = [failed(task, A, f"no card {task.number}") for task in BLOCKS[:3]]
    assert bad(run(*alike[:2], nodes=(A,))) == []
    state = run(*alike, nodes=(A,))
    assert bad(state) == ["gpu-a"]
    assert {state.task(task).errors for task in BLOCKS[:3]} == {0}


def test_a_gpu_is_put_into_quarantine_alone() -> None:
    on_one = [failed(task, FOUR, gpu=3) for task in BLOCKS[:3]]
    for nodes in ((FOUR,), (A, FOUR)):
        state = run(*on_one, nodes=nodes)
        (card,) = state.quarantined()
        assert (card.id, card.host) == ("GPU-3", "gpu-f, GPU 3")
        assert quarantine.usable(state, [FOUR])[0].closed == (3,)
        assert quarantine.excuses(state, (FOUR.id, "GPU-3"), Failure.ERROR)
        assert not quarantine.excuses(state, (FOUR.id, "GPU-2"), Failure.ERROR)
        assert {state.task(task).errors for task in BLOCKS[:3]} == {0}
        more = run(*on_one, failed(BLOCKS[3], FOUR, gpu=0), nodes=nodes)
        assert bad(more) == ["gpu-f, GPU 3"]  # what has failed on it counts no more against the node


def test_failures_on_several_gpus_are_those_of_their_node() -> None:
    spread = [failed(task, FOUR, gpu=gpu) for gpu, task in enumerate(BLOCKS[:3])]
    assert bad(run(*spread, nodes=(A, FOUR))) == ["gpu-f"]
    one_each = [failed(task, FOUR, "no driver", gpu=task.number % 4) for task in BLOCKS]
    assert bad(run(*one_each[:3], nodes=(FOUR,))) == ["gpu-f"]


def test_a_success_on_another_gpu_does_not_clear_a_bad_one() -> None:
    saved: list[Record] = [
        replace(started(BLOCKS[8], node=FOUR.id), card="GPU-0"),
        CheckpointSaved(BLOCKS[8], 5, "c", 1),
    ]
    two: list[Record] = [failed(task, FOUR, gpu=3) for task in BLOCKS[:2]]
    assert bad(run(*two, *saved, failed(BLOCKS[2], FOUR, gpu=3), nodes=(FOUR,))) == ["gpu-f, GPU 3"]


def test_a_success_in_between_clears_a_node() -> None:
    saved: list[Record] = [started(BLOCKS[8], node=A.id), CheckpointSaved(BLOCKS[8], 5, "c", 1)]
    elsewhere: list[Record] = [started(BLOCKS[8], node=B.id), model(BLOCKS[8])]
    two: list[Record] = [failed(task, A) for task in BLOCKS[:2]]
    third = failed(BLOCKS[2], A)
    assert bad(run(*two, *saved, third)) == []
    assert bad(run(*two, *elsewhere, third)) == ["gpu-a"]


def test_failures_on_a_bad_node_do_not_count_against_its_tasks() -> None:
    lost = failed(BLOCKS[1], A, kind=Failure.LOST)
    good = [failed(BLOCKS[0], B), failed(BLOCKS[0], A), lost]
    before = after(PLAN, *good, TaskFailed(BLOCKS[2], 3, "block/002: no", final=True, node=A.id))
    counts = [(before.task(task).errors, before.task(task).losses) for task in BLOCKS[:3]]
    assert counts == [(2, 0), (0, 1), (1, 0)]
    assert before.status(BLOCKS[2]) == Status.FAILED
    state = review(before, 1.0)
    counts = [(state.task(task).errors, state.task(task).losses) for task in BLOCKS[:3]]
    assert counts == [(1, 0), (0, 0), (0, 0)]
    assert state.status(BLOCKS[2]) == Status.WAITING
    assert quarantine.excuses(state, (A.id, ""), Failure.LOST)
    assert not quarantine.excuses(state, (A.id, ""), Failure.MEMORY)
    assert not quarantine.excuses(state, (B.id, ""), Failure.LOST)


def test_tasks_that_fail_alike_on_a_sound_node_are_the_cause_themselves() -> None:
    sound: list[Record] = [started(BLOCKS[8], node=B.id), CheckpointSaved(BLOCKS[8], 5, "c", 1)]
    two: list[Record] = [
        failed(BLOCKS[0], A),
        failed(BLOCKS[0], B),
        failed(BLOCKS[1], A),
        failed(BLOCKS[2], A),
    ]
    assert bad(run(*sound, *two)) == []
    assert bad(run(*two)) == ["gpu-a"]  # of B nothing good is known
    state = run(*(failed(task, A) for task in BLOCKS[:3]), *sound, failed(BLOCKS[2], B))
    assert bad(state) == []  # found out after the quarantine


def test_a_node_is_released_after_its_time() -> None:
    state = run(*(failed(task, A) for task in BLOCKS[:3]))
    assert bad(review(state, 61.0)) == ["gpu-a"]
    assert bad(review(state, 62.0)) == []
    assert bad(review(state, -1000.0)) == []  # the clock was set back
    again = review(review(state, 62.0), 63.0)
    assert bad(again) == []  # its old failures are forgotten


def test_a_new_driver_knows_of_a_quarantine_unless_the_run_had_failed() -> None:
    three: list[Record] = [failed(task, A) for task in BLOCKS[:3]]
    assert bad(run(*three, AGAIN)) == ["gpu-a"]
    ended = RunEnded(Outcome.FAILED, "no")
    assert bad(run(*three, ended, AGAIN)) == []
    assert bad(run(*three[:2], AGAIN, three[2])) == []


# With the driver


def breaks_on(node: Node, harness: Harness, *, stage: Stage | None = None) -> Script:
    """All tasks, or those of a stage, fail on a node, each with the same words."""

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if harness.pool.placement(spec.task).node == node.id and stage in (None, spec.task.stage):
            raise CrashError(Failed(f"{spec.task}: CUDA error: uncorrectable ECC error"))
        yield from well(spec)

    return script


@pytest.fixture
def many(tmp_path: Path) -> Harness:
    """A run of eight blocks on two nodes, of which the worse has more cores."""
    nodes = (Node(A.id, A.host, 4, 2**40), Node(B.id, B.host, 1, 2**40))
    return Harness(tmp_path, nodes, blocks="4x2x1", retries=0)


def test_one_bad_node_does_not_eat_the_run(many: Harness) -> None:
    assert many.drive(breaks_on(A, many, stage=Stage.BLOCK)).outcome == "done"
    (quarantined,) = many.records(NodeQuarantined)
    assert (quarantined.node, quarantined.host) == (A.id, A.host)
    after = [where.node for where, spec in many.pool.started][-3:]
    assert set(after) == {B.id}
    assert {failed.node for failed in many.records(TaskFailed)} == {A.id}


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


def test_a_read_error_of_one_node_does_not_end_the_run(tmp_path: Path) -> None:
    """Also one that the worker takes for wrong input."""
    harness = Harness(tmp_path, (A, B))

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if harness.pool.placement(spec.task).node == A.id:
            raise CrashError(Failed("a.jpg is truncated", Failure.INPUT))
        yield from well(spec)

    assert harness.drive(script).outcome == "done"
    assert {failed.then for failed in harness.records(TaskFailed)} == {
        "tried again before the input counts as wrong"
    }


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
