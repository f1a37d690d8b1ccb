"""Nodes that announce that they leave, whose tasks move, and machines that come as they are requested."""

from collections.abc import Iterator, Mapping, Set
from contextlib import nullcontext
from pathlib import Path
from socket import gethostname

import pytest
import torch

from panolog.orchestrator.engine.driver.driver import Hooks
from panolog.orchestrator.engine.driver.policy import LOSSES
from panolog.orchestrator.engine.scheduling import leaving
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.pool import NONE
from panolog.orchestrator.engine.scheduling.scaling import Group, Growth
from panolog.orchestrator.runs.machines.history import leave_of
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.records import (
    Leaving,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeStaying,
    Noticed,
    Outcome,
    RunContinued,
    RunWaiting,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, apply
from panolog.scene.errors import RunError
from panolog.workers.events import Calibration, Checkpoint, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Progress, Stage, TaskId
from tests.orchestrator import fakes
from tests.orchestrator.fakes import LOST_NODE, CrashError, FakePool, Harness, Script, SetClock, begins, well
from tests.orchestrator.history import AGAIN, after

A, B = Node("aaaa", "spot-a", 1, 2**40), Node("bbbb", "spot-b", 1, 2**40)
SOON = LeaveNotice(Leaving.PREEMPTION, 120.0)


def test_a_notice_is_recorded_once_and_so_are_its_withdrawal_and_the_end() -> None:
    leaves = [NodeLeaving("aaaa", "spot-a", Leaving.PREEMPTION, 120.0)]
    assert leaving.changes(RunState(), [A, B], {"aaaa": SOON}) == leaves
    state = after(*leaves)
    (known,) = state.leaving()
    assert known.leave is not None
    assert known.leave.until == 121.0
    assert leaving.changes(state, [A, B], {"aaaa": LeaveNotice(Leaving.PREEMPTION, 7.0)}) == []
    assert leaving.changes(state, [A, B], {}) == [NodeStaying("aaaa", "spot-a")]
    assert leaving.changes(state, [B], {}) == [NodeLeft("aaaa", "spot-a")]
    gone = apply(state, [Stored(2, 230.0, NodeLeft("aaaa", "spot-a"))])
    assert gone.leaving() == ()
    assert leave_of(gone.nodes, "aaaa") is not None  # what was lost with it is known to be that
    assert leaving.changes(gone, [B], {}) == []
    assert leave_of(apply(gone, [Stored(3, 240.0, AGAIN)]).nodes, "aaaa") is None
    assert len(state.notices) == 1


def test_what_may_never_come_counts_only_where_another_node_stays() -> None:
    state = after(NodeLeaving("aaaa", "spot-a", Leaving.REBALANCE))
    assert leaving.staying(state, [A, B]) == [B]
    assert leaving.staying(state, [A]) == [A]
    both = apply(state, [Stored(2, 100.0, NodeLeaving("bbbb", "spot-b", Leaving.PREEMPTION))])
    assert leaving.staying(both, [A, B]) == [A]
    worse = leaving.changes(state, [A], {"aaaa": SOON})
    assert [type(record) for record in worse] == [NodeLeaving]


def noticed(run: Harness, task: TaskId = COARSE) -> Script:
    """The node of the first attempt at a task gets its notice; the worker trains until it is to stop."""

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if spec.task != task or len(run.attempts(task)) > 1:
            yield from well(spec)
            return
        yield Progress(task, 1, 9, 1.0)
        run.pool.leaving[run.pool.placement(task).node] = SOON
        for iteration in range(2, 9):
            yield Progress(task, iteration, 9, 1.0)
            if task in run.pool.stopped:
                yield Checkpoint(task, iteration, {"iteration": torch.tensor(iteration)})
                return
        raise AssertionError("it is not requested to stop")

    return script


def test_tasks_save_and_move_at_once(tmp_path: Path) -> None:
    run, task = Harness(tmp_path, (A, B), retries=0), TaskId.block(1)
    assert run.drive(noticed(run, task)).outcome == Outcome.DONE
    (leaves,) = run.records(NodeLeaving)
    assert (leaves.kind, leaves.seconds) == (Leaving.PREEMPTION, 120.0)
    (yielded,) = run.records(TaskYielded)
    assert yielded == TaskYielded(task, leaves.host)
    first, second = [record for record in run.records(TaskStarted) if record.task == task]
    assert first.node_id == leaves.node != second.node_id
    assert second.iteration >= 2  # the checkpoint that was saved then
    after = run.tasks.index(task) + 1
    assert all(where.node != leaves.node for where, spec in run.pool.started[after:] if spec.task == task)
    assert not run.records(TaskFailed)
    assert not run.records(NodeQuarantined)
    assert run.state.task(task).moves == 1


class SlowPool(FakePool):
    """The node of the first block leaves before its worker has begun, and nothing more comes from there."""

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        super().start(placement, spec)
        if spec.task.stage is Stage.BLOCK and not self.leaving:
            self.leaving[placement.node] = SOON

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        silent = {task for task in self.running if self.placement(task).node in self.leaving}
        return super().ready(seconds, ignored | silent)


def test_a_task_that_has_not_begun_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fakes, "FakePool", SlowPool)
    run = Harness(tmp_path, (A, B))
    assert run.drive().outcome == Outcome.DONE
    (leaves,) = run.records(NodeLeaving)
    blocks = [where.node for where, spec in run.pool.started if spec.task.stage is Stage.BLOCK]
    assert blocks.count(leaves.node) == 1
    begun = [record for record in run.records(TaskStarted) if record.task.stage is Stage.BLOCK]
    assert leaves.node not in {record.node_id for record in begun}
    assert not run.records(TaskFailed) + run.records(TaskYielded)


def lost_with_node(run: Harness, times: int) -> Script:
    """Stage I is lost so often with a node that announces its end too late, and each time another joins."""

    def announce() -> None:
        where = run.pool.placement(COARSE).node
        run.pool.join(Node(f"{where}a", f"spot-{where}", 1, 2**40))
        run.pool.leaving[where] = LeaveNotice(Leaving.PREEMPTION, 0.0)

    def leave() -> None:
        run.pool.leave(run.pool.placement(COARSE).node)

    return begins(COARSE, announce, Progress(COARSE, 1, 9, 1.0), leave, CrashError(LOST_NODE), times=times)


@pytest.mark.parametrize("limit", [{}, {"preemptions": LOSSES + 2}])
def test_losses_by_preemption_are_endless_by_default_and_count_against_no_node(
    tmp_path: Path, limit: dict[str, int]
) -> None:
    run = Harness(tmp_path, (A,), retries=0, quarantine={"failures": 1}, **limit)
    with pytest.raises(RunError, match="died") if limit else nullcontext():
        run.drive(lost_with_node(run, LOSSES + 3))
    failed = run.records(TaskFailed)
    assert [record.final for record in failed] == [False] * (LOSSES + 2) + [bool(limit)]
    assert all(record.preempted for record in failed)
    assert not run.records(NodeQuarantined)
    assert len(run.records(NodeLeft)) == LOSSES + 3


def test_a_node_whose_notice_is_withdrawn_is_used_again(tmp_path: Path) -> None:
    run = Harness(tmp_path, (A,))
    withdrawn = begins(COARSE, lambda: run.pool.when_waiting(run.pool.leaving.clear), rest=noticed(run))
    assert run.drive(withdrawn).outcome == Outcome.DONE
    assert len(run.records(NodeStaying)) == 1
    waits = [notice.message for notice in run.records(Noticed)]
    assert any(message.startswith("every machine leaves") for message in waits)


def test_when_the_machine_of_the_driver_leaves_all_tasks_save_and_nothing_begins(tmp_path: Path) -> None:
    """A run ends with its driver's machine: what tasks elsewhere had trained on until then was lost."""
    head = Node("head", gethostname(), 0, 2**40)
    run, blocks = Harness(tmp_path, (head, A, B), retries=0), {TaskId.block(0), TaskId.block(1)}
    begun: list[int] = []

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if spec.task not in blocks or len(run.attempts(spec.task)) > 1:
            yield from well(spec)
            return
        yield Progress(spec.task, 1, 9, 1.0)
        if blocks <= set(run.pool.running):
            run.pool.leaving["head"] = SOON
        for iteration in range(2, 99):
            yield Progress(spec.task, iteration, 99, 1.0)
            if spec.task in run.pool.stopped:
                yield Checkpoint(spec.task, iteration, {"iteration": torch.tensor(iteration)})
                return
        raise AssertionError("it is not requested to stop")

    def wait() -> None:  # nothing runs: the machine is still there
        begun.append(len(run.tasks))
        if len(begun) == 5:
            run.pool.leaving.clear()

    pool = FakePool(script, run.nodes)
    pool.when_waiting(wait)
    assert run.drive(pool=pool).outcome == Outcome.DONE
    assert {record.task for record in run.records(TaskYielded)} == blocks
    assert len(begun) >= 5 and len(set(begun[:5])) == 1  # nothing has begun meanwhile
    assert not run.records(TaskFailed)


def test_a_rebalance_of_the_driver_s_machine_may_never_come_and_changes_nothing(tmp_path: Path) -> None:
    head = Node("head", gethostname(), 0, 2**40)
    run = Harness(tmp_path, (head, A))
    pool = FakePool(well, run.nodes)
    pool.leaving["head"] = LeaveNotice(Leaving.REBALANCE)
    assert run.drive(pool=pool).outcome == Outcome.DONE
    assert not run.records(TaskYielded)


# A driver whose machines come when it requests them


GROUP = Group("small", most=3, cpus=1, memory=2**40)


class GrowingPool(FakePool):
    """One machine joins each time that the driver waits, if it has requested some."""

    def __init__(self, clock: SetClock, startup: float) -> None:
        super().__init__(self._work, [])
        self._clock, self._startup = clock, startup
        self.wanted: dict[str, int] = {}
        self.requests: list[dict[str, int]] = []
        self.trouble = ""
        self.when_waiting(self._join)

    def _work(self, spec: TaskSpec) -> Iterator[Event]:
        self._clock.now += 600
        yield from well(spec)

    def _join(self) -> None:
        self._clock.now += self._startup
        if self.wanted.get("small") and len(self.nodes()) < GROUP.most:
            self.join(GROUP.node(len(self.nodes())))

    def growth(self) -> Growth:
        members = {node.id: "small" for node in self.nodes()}
        return Growth((GROUP,), members, trouble=self.trouble)

    def request(self, wanted: Mapping[str, int]) -> None:
        if wanted != self.wanted:
            self.wanted = dict(wanted)
            self.requests.append(self.wanted)


def test_a_run_without_a_machine_requests_some_while_it_needs_them_and_says_what_it_waits_for(
    harness: Harness,
) -> None:
    harness.clock = clock = SetClock()
    pool, planning = GrowingPool(clock, startup=120), list[dict[str, int]]()
    harness.drive(pool=pool, hooks=Hooks(lambda *_: planning.append(dict(pool.wanted))))
    waits = [record.reason for record in harness.records(RunWaiting)]
    assert waits[0].startswith("waiting for machines: 1 of small (1 core, 1024.0 GiB), requested from Ray's")
    assert [record.seconds for record in harness.records(RunContinued)] == [120]
    messages = [record.message for record in harness.records(Noticed)]
    assert "requested from Ray's autoscaler for coarse: 1 more of small (1 core, 1024.0 GiB)" in messages
    assert planning == [{}]  # the driver works itself
    assert pool.requests == [{"small": 1}, {}]
    assert harness.state.waiting == ""


def test_why_no_machine_comes_is_said_again_when_it_changes(harness: Harness) -> None:
    harness.clock = clock = SetClock()
    pool = GrowingPool(clock, startup=20)
    left = ["no spot machines left", "quota exceeded"]

    def join() -> None:
        clock.now += 20
        pool.trouble = left.pop(0) if left else ""
        if not pool.trouble:
            pool.join(GROUP.node(0))

    pool.when_waiting(join)
    harness.drive(pool=pool)
    waits = [record.reason.rpartition("; ")[2] for record in harness.records(RunWaiting)]
    assert waits[1:3] == ["it reports: no spot machines left", "it reports: quota exceeded"]


def test_a_cluster_without_an_autoscaler_says_that_it_has_no_machine(harness: Harness) -> None:
    harness.clock = SetClock()
    pool = FakePool(well, [])
    pool.when_waiting(lambda: pool.join(Node("a", "host", 1, 2**40)) if not pool.nodes() else None)
    harness.drive(pool=pool)
    (waiting,) = harness.records(RunWaiting)
    assert waiting.reason == "waiting for a machine with a core: the cluster has none now"
    assert harness.state.task(COARSE).attempts == 1
