"""What goes wrong when, and what the benchmarks compute and report of runs that are not as they should be."""

import random
from collections import Counter
from contextlib import closing
from pathlib import Path

from benchmarks.chaos import notices
from benchmarks.chaos.__main__ import Outcome
from benchmarks.chaos.fault_costs import Fault, FaultCost
from benchmarks.chaos.faults import LIMITS, Kind, plans
from benchmarks.chaos.notice_costs import NoticeCost, notice_cost
from benchmarks.chaos.queue import Queued
from benchmarks.chaos.runs import Run
from panolog.orchestrator.queue.entries import Command, State
from panolog.orchestrator.queue.store import Queue
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Failure,
    Leaving,
    NodeLeaving,
    Progressed,
    Record,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.run.store import Database
from panolog.workers.tasks import COARSE
from tests.benchmarks.histories import history
from tests.orchestrator.history import AGAIN, BEGAN, started


def test_equal_seeds_give_equal_plans_with_every_kind_equally_often() -> None:
    first, again, other = (list(plans(40, seed, 40.0, tuple(Kind))) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2}
    assert all([it.after for it in plan] == sorted(it.after for it in plan) for plan in first)
    counts = Counter(planned.kind for plan in first for planned in plan)
    assert counts.keys() == LIMITS.keys() == set(Kind)
    assert max(counts.values()) - min(counts.values()) <= 1
    lengths = (120.0, 30.0, 0.0)
    assert [planned.seconds for planned in notices.plans(6, 0, lengths)] == [*lengths, *lengths]


def test_other_bytes_and_too_long_losses_are_reported() -> None:
    allowed = 2.0 + LIMITS[Kind.WORKER].costs
    long = FaultCost((Fault(5.0, Kind.WORKER, "kill"),), (COARSE,), 3.0, ((5.0, 5.0 + allowed),))
    short = FaultCost((Fault(9.0, Kind.WORKER, "kill"),), (COARSE,), 1.0, ((9.0, 9.0 + allowed - 1),))
    runs = [Run(0, 0.0, 30.0, (), "a", ""), Run(1, 0.0, 45.0, (long, short), "b", "")]
    outcome = Outcome(tuple(runs), interval=2.0)
    assert outcome.failures() == [
        "run 1: other bytes",
        f"run 1: lost {allowed + 3:.1f} s of {allowed:.1f} s",
    ]
    assert [row[0] for row in outcome.rows()] == [1, 1]
    failed = Outcome((runs[0], Run(1, 0.0, 9.0, (), "", "exit code 1: no")), 2.0)
    assert failed.failures() == ["run 1: exit code 1: no"]


def begun(folder: RunFolder, time: float, model: bytes) -> None:
    folder.root.mkdir()
    folder.point_cloud.write_bytes(model)
    with closing(Database(folder.database)) as database:
        database.store([(time, BEGAN), (time + 9, AGAIN)])


def test_states_order_and_bytes_of_queued_runs_are_checked(tmp_path: Path) -> None:
    queued = Queued(tmp_path, 1, random.Random(0))
    with closing(Queue(tmp_path / "queue")) as queue:
        for number, (time, model) in enumerate([(1.0, b"a"), (3.0, b"a"), (2.0, b"b"), (4.0, b"a")], 1):
            root = tmp_path / f"run-{number:03d}"
            queue.add(Command(root, (), (), tmp_path))
            begun(RunFolder(root), time, model)
            queue.claim(number)
            queue.end(number, State.FAILED if number == 4 else State.DONE, 0, "why")
    assert queued.wrong() == [
        "entry 4 is failed: why",
        "they began in another order: [1, 3, 2]",
        "entry 3 has other bytes than the first",
    ]
    assert queued.drivers() == 8
    queued.at_once = 2  # two that begin together may do so in either order
    assert queued.wrong() == ["entry 4 is failed: why", "entry 3 has other bytes than the first"]


BEFORE: list[tuple[float, Record]] = [
    (0.0, started(COARSE, node="a")),
    (10.0, Progressed(COARSE, 20, 100, 2.0)),
]


def test_a_task_that_moves_loses_its_checkpoint_and_its_start() -> None:
    records = history(
        *BEFORE,
        (12.0, NodeLeaving("a", "a", Leaving.PREEMPTION, 120.0)),
        (12.5, CheckpointSaved(COARSE, 24, "c", 1)),
        (13.0, TaskYielded(COARSE, "a")),
        (15.0, started(COARSE, 24, node="b")),
    )
    cost = notice_cost(records, "a", 11.0)
    assert cost == NoticeCost(COARSE, 1.0, 1.0, 2.0, 0, 3.0)
    assert cost.too_much() == []
    assert notice_cost(records, "b", 11.0) is None


def test_without_notice_a_task_repeats_what_followed_its_checkpoint() -> None:
    lost = TaskFailed(COARSE, 1, "gone", final=False, kind=Failure.LOST)
    records = history(*BEFORE, (14.0, lost), (16.0, started(COARSE, 10, node="b")))
    cost = notice_cost(records, "a", 11.0)
    assert cost == NoticeCost(COARSE, None, None, 2.0, 10, 10.0)
    assert cost.too_much() == ["coarse has trained 10 iterations twice", "coarse has lost 10.0 s of 5.0 s"]


def test_other_bytes_and_lost_time_are_reported_but_not_where_there_was_no_notice() -> None:
    bad = NoticeCost(COARSE, 1.0, 1.0, 9.0, 0, 10.0)
    runs = (
        notices.Run(0, 2, "x", ""),
        notices.Run(1, 2, "x", "", 30.0, bad),
        notices.Run(2, 2, "x", "", 0.0, bad),
        notices.Run(3, 2, "y", "", 30.0, NoticeCost(COARSE, 1.0, 1.0, 1.0, 0, 2.0)),
        notices.Run(4, 2, "", "exit code 1: no", 30.0),
    )
    outcome = notices.Outcome(runs)
    assert outcome.failures() == [
        "run 1 on 2 nodes: coarse has lost 10.0 s of 6.0 s",
        "run 3 on 2 nodes: other bytes",
        "run 4 on 2 nodes: exit code 1: no",
        "run 4 on 2 nodes: the node that left had no task",
    ]
    assert [row[-1] for row in outcome.rows()] == ["same", "same", "OTHER"]
