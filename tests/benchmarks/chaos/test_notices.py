"""Nodes that leave: what the benchmark computes and reports."""

from benchmarks.chaos.notice_costs import NoticeCost, notice_cost
from benchmarks.chaos.notices import Outcome, Run, plans, seconds_of
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Failure,
    Leaving,
    NodeLeaving,
    Progressed,
    Record,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.workers.tasks import COARSE, TaskId
from tests.benchmarks.histories import history


def began(iteration: int, node: str, task: TaskId = COARSE) -> TaskStarted:
    return TaskStarted(task, 1, iteration, node, 1, "cpu", 1, node_id=node)


def reached(iteration: int) -> Progressed:
    return Progressed(COARSE, iteration, 100, 2.0)


LEAVES = NodeLeaving("a", "a", Leaving.PREEMPTION, 120.0)
BEFORE: list[tuple[float, Record]] = [(0.0, began(0, "a")), (10.0, reached(20))]


def test_a_task_that_moves_loses_its_checkpoint_and_its_start() -> None:
    records = history(
        *BEFORE,
        (12.0, LEAVES),
        (12.5, CheckpointSaved(COARSE, 24, "c", 1)),
        (13.0, TaskYielded(COARSE, "a")),
        (15.0, began(24, "b")),
    )
    cost = notice_cost(records, "a", 11.0)
    assert cost == NoticeCost(COARSE, 1.0, 1.0, 2.0, 0, 3.0)
    assert cost.too_much() == []
    assert notice_cost(records, "b", 11.0) is None


def test_without_notice_a_task_repeats_what_followed_its_checkpoint() -> None:
    lost = TaskFailed(COARSE, 1, "gone", final=False, kind=Failure.LOST)
    records = history(*BEFORE, (14.0, lost), (16.0, began(10, "b")))
    cost = notice_cost(records, "a", 11.0)
    assert cost == NoticeCost(COARSE, None, None, 2.0, 10, 10.0)
    assert cost.too_much() == [
        "coarse has trained 10 iterations twice",
        "coarse has lost 10.0 s of 5.0 s",
    ]


def test_other_bytes_and_lost_time_are_reported_but_not_where_there_was_no_notice() -> None:
    bad = NoticeCost(COARSE, 1.0, 1.0, 9.0, 0, 10.0)
    runs = (
        Run(0, 2, "x", ""),
        Run(1, 2, "x", "", 30.0, bad),
        Run(2, 2, "x", "", 0.0, bad),
        Run(3, 2, "y", "", 30.0, NoticeCost(COARSE, 1.0, 1.0, 1.0, 0, 2.0)),
        Run(4, 2, "", "exit code 1: no", 30.0),
    )
    outcome = Outcome(runs)
    assert outcome.failures() == [
        "run 1 on 2 nodes: coarse has lost 10.0 s of 6.0 s",
        "run 3 on 2 nodes: other bytes",
        "run 4 on 2 nodes: exit code 1: no",
        "run 4 on 2 nodes: the node that left had no task",
    ]
    assert [row[-1] for row in outcome.rows()] == ["same", "same", "OTHER"]


def test_all_lengths_of_notice_come_equally_often() -> None:
    planned = list(plans(6, 0, (120.0, 30.0, 0.0)))
    assert [plan.seconds for plan in planned] == [120.0, 30.0, 0.0] * 2
    assert seconds_of("120,0") == (120.0, 0.0)
