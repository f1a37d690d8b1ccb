"""What a benchmark reads from a run's history."""

from benchmarks.runs import clock, stage_seconds
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Merged,
    Noticed,
    Outcome,
    Part,
    Preparing,
    RunEnded,
    ScoresSaved,
)
from panolog.workers.tasks import COARSE, TaskId
from tests.benchmarks.histories import history
from tests.orchestrator.history import AGAIN, BEGAN, model, started

ZERO = TaskId.block(0)


def test_the_start_of_workers_may_count_or_not() -> None:
    first = ((100.0, BEGAN), (112.0, started(COARSE)), (120.0, model(COARSE)))
    records = history(*first, (200.0, AGAIN), (205.0, started(ZERO)), (209.0, model(ZERO)))
    assert stage_seconds(records) == {"coarse": 20, "block": 9}
    assert stage_seconds(records, start=False) == {"coarse": 8, "block": 4}
    assert clock(records, start=False) == {3: 8, 6: 12}


def test_the_stages_add_up_to_the_run() -> None:
    """What precedes the first task, and a preflight, do not count as training."""
    records = history(
        (80.0, BEGAN),
        (81.0, Preparing("calibrating")),
        (89.0, Noticed(Part.PREFLIGHT, "it fits")),
        (100.0, Preparing("starting workers")),
        (110.0, model(COARSE)),
        (112.0, ScoresSaved(TaskId.shard(0), "000.npz", 4)),
        (114.0, started(ZERO)),
        (121.0, model(ZERO)),
        (122.0, Merged("point_cloud.ply", 10, 1, 100, 1.0)),
        (122.5, RunEnded(Outcome.DONE)),
    )
    assert stage_seconds(records) == {"coarse": 10, "score": 2, "block": 9, "merge": 1, "": 0.5}


def test_time_without_a_driver_does_not_count() -> None:
    records = history(
        (0.0, model(COARSE)),  # borrowed from another run
        (5.0, BEGAN),
        (6.0, started(ZERO)),
        (9.0, CheckpointSaved(ZERO, 10, "checkpoint", 1)),
        (500.0, AGAIN),  # the first was killed
        (502.0, model(ZERO)),
    )
    assert stage_seconds(records) == {"block": 6}
