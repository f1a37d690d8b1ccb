"""What benchmarks compute from what they have measured, and the loads that they make."""

import pytest

from benchmarks.driver import lost
from benchmarks.processes import in_fresh_process, peak_memory
from benchmarks.runs import clock, stage_seconds
from panolog.orchestrator.runs.records import Progressed, Stored
from panolog.orchestrator.runs.thinning import DENSE
from panolog.workers.tasks import TaskId
from tests.benchmarks.histories import ONE, ZERO, written


def test_lost_repeated_and_late_events_are_counted() -> None:
    received = [(ZERO, 1), (ZERO, 2), (ONE, 1), (ONE, 3)]
    records = [Stored(i, 0.0, Progressed(task, n, 9, 1.0)) for i, (task, n) in enumerate(received)]
    assert lost({ZERO: 2, ONE: 1}, records) == 0
    assert lost({ZERO: 3, ONE: 3, TaskId.block(2): 1}, records) == 3
    assert lost({ZERO: 2, ONE: 3}, records[::-1]) == 3
    kept = [Stored(i, 0.0, Progressed(ZERO, i, 300, 1.0)) for i in (*range(1, DENSE + 1), 200, 300)]
    assert lost({ZERO: 300}, kept) == 0
    assert lost({ZERO: 300}, kept[:-1]) == 1


def test_a_fresh_process_shares_no_memory_and_its_error_comes_back() -> None:
    held = bytes(range(256)) * 2**18  # 64 MiB, all pages written
    assert in_fresh_process(peak_memory) < peak_memory() - len(held)
    with pytest.raises(ValueError, match="invalid literal"):
        in_fresh_process(int, "nothing")


def test_the_start_of_workers_may_count_or_not() -> None:
    records = written(
        "100 began, 112 started coarse, 120 model coarse, 200 again, 205 started 0, 209 model 0"
    )
    assert stage_seconds(records) == {"coarse": 20, "block": 9}
    assert stage_seconds(records, start=False) == {"coarse": 8, "block": 4}
    assert clock(records, start=False) == {3: 8, 6: 12}


def test_the_stages_add_up_to_the_run() -> None:
    """What precedes the first task, and a preflight, do not count as training."""
    records = written(
        "80 began, 81 calibrating, 89 preflight, 100 starting, 103 started coarse, 110 model coarse,"
        " 112 scores shard, 113 started 0, 114 started 1, 120 model 0, 121 model 1, 122 merged, 122.5 done"
    )
    assert stage_seconds(records) == {"coarse": 10, "score": 2, "block": 9, "merge": 1, "": 0.5}


def test_time_without_a_driver_does_not_count() -> None:
    """Nor does what was borrowed from another run."""
    records = written("0 model coarse, 5 began, 6 started 0, 9 saved 0, 500 again, 502 model 0")
    assert stage_seconds(records) == {"block": 6}
