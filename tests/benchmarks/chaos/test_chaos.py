"""The chaos benchmark: equal seeds kill alike, and a run under its kills ends as the undisturbed one."""

from pathlib import Path

import psutil
import pytest

from benchmarks.chaos.__main__ import VICTIMS, Outcome, Run, chaos, plans
from benchmarks.chaos.kill_costs import Kill, KillCost
from panolog.workers.tasks import COARSE

pytestmark = pytest.mark.system


def test_equal_seeds_give_equal_plans() -> None:
    first, again, other = (list(plans(30, seed, 40.0)) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2, 3}
    assert {planned.victim for plan in first for planned in plan} == set(VICTIMS)
    for plan in first:
        assert [planned.after for planned in plan] == sorted(planned.after for planned in plan)


def test_other_bytes_and_too_long_losses_are_reported() -> None:
    long = KillCost((Kill(5.0, "worker"),), (COARSE,), redone=3.0, recovery=10.0)
    short = KillCost((Kill(9.0, "worker"),), (COARSE,), redone=1.0, recovery=9.0)
    runs = [Run(0, 0.0, 30.0, (), "a", ""), Run(1, 0.0, 45.0, (long, short), "b", "")]
    outcome = Outcome(tuple(runs), interval=2.0)
    assert outcome.failures() == ["run 1: other bytes", "run 1: lost 13.0 s of 12.0 s"]
    assert [row[0] for row in outcome.rows()] == [1, 1]
    failed = Outcome((runs[0], Run(1, 0.0, 9.0, (), "", "exit code 1: no")), 2.0)
    assert failed.failures() == ["run 1: exit code 1: no"]


def test_a_run_survives_and_nothing_is_left(tmp_path: Path) -> None:
    before = set(psutil.pids())
    outcome = chaos(tmp_path, runs=1, seed=4)
    assert outcome.runs[1].kill_costs
    assert outcome.runs[1].digest == outcome.undisturbed.digest, outcome.runs[1].end
    ours = [psutil.Process(pid) for pid in set(psutil.pids()) - before if psutil.pid_exists(pid)]
    assert not [process for process in ours if process.ppid() == psutil.Process().pid]
