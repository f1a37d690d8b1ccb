"""The driver's benchmark: whole simulated runs, in which a lost event would show."""

from pathlib import Path

import pytest

from benchmarks.driver_scale.__main__ import Load, lost, measure
from benchmarks.driver_scale.simulated_pool import grid
from panolog.orchestrator.run.records import Progressed, Stored
from panolog.workers.tasks import TaskId

pytestmark = pytest.mark.system


def test_every_event_of_a_small_run_is_in_the_database(tmp_path: Path) -> None:
    measured = measure(tmp_path, Load(blocks=6, workers=3, rate=20, seconds=0.5))
    assert measured.events >= 6 * 8
    assert measured.lost == 0
    assert measured.seconds > 2 * 0.4
    assert measured.cpu > 0
    assert set(measured.status) == {"function", "command"}
    assert all(times["median"] > 0 for times in measured.status.values())


ZERO, ONE = TaskId.block(0), TaskId.block(1)


def test_lost_repeated_and_late_events_are_counted() -> None:
    received = [(ZERO, 1), (ZERO, 2), (ONE, 1), (ONE, 3)]
    records = [Stored(i, 0.0, Progressed(task, n, 9, 1.0)) for i, (task, n) in enumerate(received)]
    assert lost({ZERO: 2, ONE: 1}, records) == 0
    assert lost({ZERO: 3, ONE: 3, TaskId.block(2): 1}, records) == 4


def test_grids_are_as_cubic_as_they_can_be() -> None:
    assert [str(grid(blocks)) for blocks in (1, 12, 7, 1000)] == ["1x1x1", "3x2x2", "7x1x1", "10x10x10"]
