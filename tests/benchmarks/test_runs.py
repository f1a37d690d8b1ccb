"""What a benchmark reads from a run's history."""

from benchmarks.runs import clock, stage_seconds
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Merged,
    Noticed,
    Outcome,
    Part,
    PreflightSaved,
    Preparing,
    RunBegan,
    RunEnded,
    ScoresSaved,
)
from panolog.workers.tasks import COARSE, TaskId
from tests.benchmarks.histories import history, model, started


def test_the_start_of_workers_may_count_or_not() -> None:
    records = history(
        (100.0, RunBegan("host", 1, resumed=False)),
        (112.0, started(COARSE)),
        (120.0, model(COARSE)),
        (200.0, RunBegan("host", 2, resumed=True)),
        (205.0, started(TaskId.block(0))),
        (209.0, model(TaskId.block(0))),
    )
    assert stage_seconds(records) == {"coarse": 20, "block": 9}
    assert stage_seconds(records, start=False) == {"coarse": 8, "block": 4}
    assert clock(records, start=False) == {3: 8, 6: 12}


def test_the_stages_add_up_to_the_run() -> None:
    records = history(
        (80.0, RunBegan("host", 1, resumed=False)),
        (81.0, Preparing("calibrating")),
        (89.0, Noticed(Part.PREFLIGHT, "it fits")),
        (89.0, PreflightSaved("preflight.json", {})),
        (100.0, Preparing("starting workers")),
        (103.0, started(COARSE)),
        (110.0, model(COARSE)),
        (112.0, ScoresSaved(TaskId.shard(0), "000.npz", 4)),
        (113.0, started(TaskId.block(0))),
        (114.0, started(TaskId.block(1))),
        (120.0, model(TaskId.block(0))),
        (121.0, model(TaskId.block(1))),
        (122.0, Merged("point_cloud.ply", 10, 1, 100, 1.0)),
        (122.5, RunEnded(Outcome.DONE)),
    )
    assert stage_seconds(records) == {"coarse": 10, "score": 2, "block": 9, "merge": 1, "": 0.5}


def test_time_without_a_driver_does_not_count() -> None:
    records = history(
        (0.0, model(COARSE)),  # borrowed from another run
        (5.0, RunBegan("host", 1, resumed=False)),
        (6.0, started(TaskId.block(0))),
        (9.0, CheckpointSaved(TaskId.block(0), 10, "checkpoint", 1)),
        (500.0, RunBegan("host", 2, resumed=True)),  # the first was killed
        (502.0, model(TaskId.block(0))),
    )
    assert stage_seconds(records) == {"block": 6}
