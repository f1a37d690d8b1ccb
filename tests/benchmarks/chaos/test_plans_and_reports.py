"""Which faults come when, and what the benchmarks report of runs that are not as they should be."""

import argparse
import random
from contextlib import closing
from pathlib import Path

import pytest

from benchmarks.chaos.__main__ import Outcome, kinds_of
from benchmarks.chaos.fault_costs import Fault, FaultCost
from benchmarks.chaos.faults import LIMITS, Kind, plans
from benchmarks.chaos.queue import Queued
from benchmarks.chaos.runs import Run
from panolog.orchestrator.queue.entries import Command, State
from panolog.orchestrator.queue.store import Queue
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.store import Database
from panolog.workers.tasks import COARSE


def test_equal_seeds_give_equal_plans_with_every_kind_equally_often() -> None:
    first, again, other = (list(plans(40, seed, 40.0, tuple(Kind))) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2}
    for plan in first:
        assert [planned.after for planned in plan] == sorted(planned.after for planned in plan)
    kinds = [planned.kind for plan in first for planned in plan]
    counts = {kind: kinds.count(kind) for kind in Kind}
    assert max(counts.values()) - min(counts.values()) <= 1
    assert LIMITS.keys() == set(Kind)


def test_faults_are_chosen_by_name() -> None:
    assert kinds_of("all") == tuple(Kind)
    assert kinds_of("kill,hang") == (Kind.DRIVER, Kind.WORKER, Kind.RAYLET, Kind.HANG)
    with pytest.raises(argparse.ArgumentTypeError, match=r"flood.*enospc"):
        kinds_of("hang,flood")


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
        database.store([(time, RunBegan("host", 1, False)), (time + 9, RunBegan("host", 2, True))])


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
