"""The chaos benchmark: what it reports, and that a run with faults ends as the undisturbed one."""

from pathlib import Path

import psutil
import pytest

from benchmarks.chaos.__main__ import Outcome, chaos
from benchmarks.chaos.fault_costs import Fault, FaultCost
from benchmarks.chaos.faults import LIMITS, Kind
from benchmarks.chaos.runs import Run
from panolog.workers.tasks import COARSE


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


@pytest.mark.system
def test_a_run_survives_and_nothing_is_left(tmp_path: Path) -> None:
    before = set(psutil.pids())
    outcome = chaos(tmp_path, runs=1, seed=4, kinds=(Kind.DRIVER, Kind.EIO))
    assert outcome.runs[1].costs
    assert outcome.runs[1].digest == outcome.undisturbed.digest, outcome.runs[1].end
    ours = [psutil.Process(pid) for pid in set(psutil.pids()) - before if psutil.pid_exists(pid)]
    assert not [process for process in ours if process.ppid() == psutil.Process().pid]
