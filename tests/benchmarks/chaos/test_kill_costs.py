"""What a kill has cost, from histories made by hand."""

import pytest

from benchmarks.chaos.kill_costs import Kill, kill_costs, longest_unsaved
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Outcome,
    RunBegan,
    RunEnded,
    ScoresSaved,
    TaskFailed,
)
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.benchmarks.histories import history, model, started


def saved(task: TaskId) -> CheckpointSaved:
    return CheckpointSaved(task, 10, "checkpoint", 1)


BEGAN, AGAIN = RunBegan("host", 1, resumed=False), RunBegan("host", 2, resumed=True)
DIED = "the worker process died"


def test_a_worker_takes_back_its_work_since_the_checkpoint_and_the_time_to_start_again() -> None:
    records = history(
        (0.0, BEGAN),
        (1.0, started(TaskId.block(0))),
        (1.5, started(TaskId.block(1))),
        (4.0, saved(TaskId.block(0))),
        (9.0, TaskFailed(TaskId.block(0), 1, DIED, final=False)),
        (11.0, started(TaskId.block(0), 2)),
        (20.0, model(TaskId.block(1))),
        (21.0, model(TaskId.block(0))),
    )
    (cost,) = kill_costs(records, [Kill(6.0, "worker")])
    assert cost.tasks == (TaskId.block(0),)
    assert (cost.redone, cost.recovery, cost.seconds) == (2.0, 5.0, 7.0)


def test_a_task_that_takes_the_place_of_the_dead_one_counts_as_recovery() -> None:
    records = history(
        (0.0, BEGAN),
        (1.0, started(TaskId.block(0))),
        (5.0, TaskFailed(TaskId.block(0), 1, DIED, final=False)),
        (7.0, started(TaskId.block(1))),
        (30.0, model(TaskId.block(1))),
        (31.0, started(TaskId.block(0), 2)),
    )
    assert kill_costs(records, [Kill(4.0, "worker")])[0].recovery == 3.0


def test_a_driver_takes_all_running_tasks_with_it() -> None:
    records = history(
        (0.0, BEGAN),
        (1.0, started(TaskId.block(0))),
        (2.0, started(TaskId.block(1))),
        (3.0, saved(TaskId.block(1))),
        (15.0, AGAIN),
        (16.0, started(TaskId.block(0))),
        (18.0, started(TaskId.block(1))),
        (30.0, RunEnded(Outcome.DONE)),
    )
    (cost,) = kill_costs(records, [Kill(5.0, "driver")])
    assert cost.tasks == (TaskId.block(0), TaskId.block(1))
    assert (cost.redone, cost.recovery) == (4.0, 13.0)


def test_a_driver_that_dies_between_tasks_loses_its_own_work() -> None:
    records = history(
        (0.0, BEGAN), (2.0, ScoresSaved(TaskId.shard(0), "0.npz", 4)), (9.0, AGAIN), (10.0, started(EVAL))
    )
    (cost,) = kill_costs(records, [Kill(3.0, "driver")])
    assert (cost.redone, cost.recovery) == (1.0, 7.0)
    (at_the_start,) = kill_costs(history((9.0, BEGAN), (12.0, started(COARSE))), [Kill(3.0, "driver")])
    assert (at_the_start.redone, at_the_start.recovery) == (0.0, 9.0)


def test_kills_before_the_recovery_count_together() -> None:
    records = history(
        (0.0, BEGAN),
        (1.0, started(TaskId.block(0))),
        (4.0, TaskFailed(TaskId.block(0), 1, DIED, final=False)),
        (9.0, AGAIN),
        (12.0, started(TaskId.block(0), 2)),
        (20.0, saved(TaskId.block(0))),
        (24.0, TaskFailed(TaskId.block(0), 2, DIED, final=False)),
        (25.0, started(TaskId.block(0), 3)),
    )
    kills = [Kill(3.0, "worker"), Kill(5.0, "driver"), Kill(23.0, "worker")]
    first, second = kill_costs(records, kills)
    assert first.kills == tuple(kills[:2])
    assert first.recovery == 9.0
    assert (second.redone, second.recovery) == (3.0, 2.0)


def test_a_worker_without_a_task_costs_nothing() -> None:
    records = history((0.0, BEGAN), (1.0, started(COARSE)), (9.0, model(COARSE)))
    (cost,) = kill_costs(records, [Kill(3.0, "worker")])
    assert (cost.tasks, cost.seconds) == ((), 0.0)


def test_a_task_that_had_not_begun_loses_no_work() -> None:
    failed = TaskFailed(COARSE, 1, DIED, final=False)
    records = history((3.0, BEGAN), (4.0, failed), (6.0, started(COARSE, 2)), (9.0, model(COARSE)))
    (cost,) = kill_costs(records, [Kill(2.0, "raylet")])
    assert (cost.tasks, cost.redone, cost.recovery) == ((COARSE,), 0.0, 4.0)


def test_the_longest_time_without_a_checkpoint() -> None:
    records = history(
        (0.0, BEGAN),
        (1.0, started(COARSE)),
        (4.0, saved(COARSE)),
        (5.0, started(EVAL)),
        (9.0, saved(COARSE)),
        (11.0, model(COARSE)),
    )
    assert longest_unsaved(records) == pytest.approx(5.0)
