import asyncio
from pathlib import Path

import pytest

from benchmarks.dashboard.__main__ import measure, table
from benchmarks.dashboard.simulated_run import RunSize, write_run
from panolog.orchestrator.run.state import Status, replay
from panolog.orchestrator.run.store import read_milestones
from panolog.workers.tasks import TaskId

pytestmark = pytest.mark.system


def test_a_simulated_run_is_a_run(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", RunSize(blocks=8, events=400, together=3))
    state = replay(read_milestones(folder.database))
    assert state.plan is not None
    assert len(state.plan) == 8
    statuses = [state.status(TaskId.block(block)) for block in range(8)]
    assert statuses == [Status.DONE] * 6 + [Status.RUNNING] * 2


def test_the_dashboard_is_measured(tmp_path: Path) -> None:
    size = RunSize(blocks=12, events=5_000, together=4)
    folder = write_run(tmp_path / "run", size)
    measured = asyncio.run(measure(folder, size, clients=2, records=2))
    assert measured.warm > 0
    assert min(measured.alone + measured.among) > 0
    assert 30 < measured.memory < 300
    assert "first page" in table(measured)
