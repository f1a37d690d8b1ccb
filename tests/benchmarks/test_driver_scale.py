"""The driver's benchmark: whole simulated runs, in which a lost event would show."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.driver_scale.__main__ import lost
from benchmarks.driver_scale.simulated_pool import grid
from panolog.orchestrator.run.records import Progressed, Stored
from panolog.orchestrator.run.thinning import DENSE
from panolog.workers.tasks import TaskId

pytestmark = pytest.mark.system
ZERO, ONE = TaskId.block(0), TaskId.block(1)


def test_every_event_of_a_small_run_is_in_the_database(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "benchmarks.driver_scale",
        "--quick",
        "--json",
        "--folder",
        str(tmp_path),
    ]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    measured = json.loads(ended.stdout)["report"]
    assert measured["events"] >= 12 * 8
    assert measured["lost"] == 0
    assert measured["seconds"] > 3 * 0.8
    assert measured["cpu"] > 0
    assert set(measured["status"]) == {"function", "command"}
    assert all(times["median"] > 0 for times in measured["status"].values())


def test_lost_repeated_and_late_events_are_counted() -> None:
    received = [(ZERO, 1), (ZERO, 2), (ONE, 1), (ONE, 3)]
    records = [Stored(i, 0.0, Progressed(task, n, 9, 1.0)) for i, (task, n) in enumerate(received)]
    assert lost({ZERO: 2, ONE: 1}, records) == 0
    assert lost({ZERO: 3, ONE: 3, TaskId.block(2): 1}, records) == 3
    assert lost({ZERO: 2, ONE: 3}, records[::-1]) == 3
    kept = [Stored(i, 0.0, Progressed(ZERO, i, 300, 1.0)) for i in (*range(1, DENSE + 1), 200, 300)]
    assert lost({ZERO: 300}, kept) == 0
    assert lost({ZERO: 300}, kept[:-1]) == 1


def test_grids_are_as_cubic_as_they_can_be() -> None:
    assert [str(grid(blocks)) for blocks in (1, 12, 7, 1000)] == ["1x1x1", "3x2x2", "7x1x1", "10x10x10"]
