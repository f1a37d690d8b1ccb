"""What a fault has cost, from histories made by hand."""

import pytest

from benchmarks.chaos.fault_costs import Fault, fault_costs, longest_unsaved, true_times
from benchmarks.chaos.faults import DAY_S, LIMITS, Kind
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Failure,
    Outcome,
    Record,
    RunEnded,
    ScoresSaved,
    TaskFailed,
)
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.benchmarks.histories import history
from tests.orchestrator.history import AGAIN, BEGAN, model, started


def saved(task: TaskId) -> CheckpointSaved:
    return CheckpointSaved(task, 10, "checkpoint", 1)


ZERO, ONE = TaskId.block(0), TaskId.block(1)
Timed = tuple[float, Record]


def lost(task: TaskId) -> TaskFailed:
    return TaskFailed(task, 1, "died", final=False, kind=Failure.LOST)


def unread(task: TaskId) -> TaskFailed:
    return TaskFailed(task, 1, "Input/output error", final=False)


def fault(time: float, kind: Kind, until: float = 0.0) -> Fault:
    return Fault(time, kind, str(kind), until)


# What happened, the time and kind of the fault, the tasks that it ended, seconds done again and of recovery.
CASES: dict[str, tuple[list[Timed], float, Kind, tuple[TaskId, ...], float, float]] = {
    "a worker's work since its checkpoint, and the time to its next start": (
        [
            *[(0.0, BEGAN), (1.0, started(ZERO)), (1.5, started(ONE)), (4.0, saved(ZERO))],
            *[(9.0, lost(ZERO)), (11.0, started(ZERO)), (20.0, model(ONE)), (21.0, model(ZERO))],
        ],
        *(6.0, Kind.WORKER, (ZERO,), 2.0, 5.0),
    ),
    "a task that takes the place of the dead one ends the recovery": (
        [
            *[(0.0, BEGAN), (1.0, started(ZERO)), (5.0, lost(ZERO)), (7.0, started(ONE))],
            *[(30.0, model(ONE)), (31.0, started(ZERO))],
        ],
        *(4.0, Kind.WORKER, (ZERO,), 3.0, 3.0),
    ),
    "a driver takes all running tasks with it": (
        [
            *[(0.0, BEGAN), (1.0, started(ZERO)), (2.0, started(ONE)), (3.0, saved(ONE)), (15.0, AGAIN)],
            *[(16.0, started(ZERO)), (18.0, started(ONE)), (30.0, RunEnded(Outcome.DONE))],
        ],
        *(5.0, Kind.DRIVER, (ZERO, ONE), 4.0, 13.0),
    ),
    "a driver that dies between tasks loses its own work": (
        [(0.0, BEGAN), (2.0, ScoresSaved(TaskId.shard(0), "0.npz", 4)), (9.0, AGAIN), (10.0, started(EVAL))],
        *(3.0, Kind.DRIVER, (), 1.0, 7.0),
    ),
    "a driver that dies before its first record": (
        [(9.0, BEGAN), (12.0, started(COARSE))],
        *(3.0, Kind.DRIVER, (), 0.0, 9.0),
    ),
    "a bad node costs each attempt that fails there": (
        [
            *[(0.0, BEGAN), (1.0, started(COARSE)), (4.0, saved(COARSE)), (6.0, unread(COARSE))],
            *[(8.0, started(COARSE)), (20.0, model(COARSE)), (22.0, started(ZERO)), (23.0, unread(ZERO))],
            *[(24.0, started(ONE)), (50.0, model(ONE))],
        ],
        *(2.0, Kind.BADNODE, (COARSE, ZERO), 2.0 + 1.0, 2.0 + 1.0),
    ),
    "a task that had ended loses nothing": (
        [(0.0, BEGAN), (1.0, started(COARSE)), (9.0, model(COARSE))],
        *(3.0, Kind.WORKER, (), 0.0, 0.0),
    ),
    "a task that had not begun loses no work": (
        [(3.0, BEGAN), (4.0, lost(COARSE)), (6.0, started(COARSE)), (9.0, model(COARSE))],
        *(2.0, Kind.RAYLET, (COARSE,), 0.0, 4.0),
    ),
}


@pytest.mark.parametrize(
    ("records", "time", "kind", "tasks", "redone", "recovery"), CASES.values(), ids=CASES
)
def test_the_cost_of_a_fault(
    records: list[Timed], time: float, kind: Kind, tasks: tuple[TaskId, ...], redone: float, recovery: float
) -> None:
    (cost,) = fault_costs(history(*records), [fault(time, kind)])
    assert cost.tasks == tasks
    assert (cost.redone, cost.recovery, cost.seconds) == (redone, recovery, redone + recovery)


def test_kills_before_the_recovery_count_together() -> None:
    records = history(
        *[(0.0, BEGAN), (1.0, started(ZERO)), (4.0, lost(ZERO)), (9.0, AGAIN), (12.0, started(ZERO))],
        *[(20.0, saved(ZERO)), (24.0, lost(ZERO)), (25.0, started(ZERO))],
    )
    kills = [fault(3.0, Kind.WORKER), fault(5.0, Kind.DRIVER), fault(23.0, Kind.WORKER)]
    first, second = fault_costs(records, kills)
    assert first.faults == tuple(kills[:2])
    assert first.recovery == 9.0
    assert (second.redone, second.recovery) == (3.0, 2.0)


@pytest.mark.parametrize(("begun", "others"), [(1.0, (fault(5.0, Kind.RAYLET),)), (4.0, ())])
def test_a_worker_that_hangs_has_recovered_when_its_next_attempt_begins(
    begun: float, others: tuple[Fault, ...]
) -> None:
    """Neither with the next fault, which counts together with it, nor with its hello."""
    records = history(
        *[(0.0, BEGAN), (begun, started(COARSE)), (13.0, lost(COARSE))],
        *[(16.0, started(COARSE)), (30.0, model(COARSE))],
    )
    (cost,) = fault_costs(records, [fault(3.0, Kind.HANG), *others])
    assert [one.kind for one in cost.faults] == [Kind.HANG, *(one.kind for one in others)]
    assert (cost.tasks, cost.recovery) == ((COARSE,), 13.0)
    assert cost.allowed == pytest.approx(sum(LIMITS[one.kind].costs for one in cost.faults))


@pytest.mark.parametrize(("kind", "until", "more"), [(Kind.ENOSPC, 8.0, 4.0), (Kind.CLOCK, 0.0, 0.0)])
def test_a_full_disk_and_a_clock_that_jumps_cost_the_silence_around_them(
    kind: Kind, until: float, more: float
) -> None:
    records = history((0.0, BEGAN), (1.0, started(COARSE)), (3.0, saved(COARSE)), (9.5, saved(COARSE)))
    (cost,) = fault_costs(records, [fault(4.0, kind, until)])
    assert (cost.tasks, cost.seconds, cost.allowed) == ((), 5.5, LIMITS[kind].costs + more)


def test_jumps_of_the_clock_are_taken_back() -> None:
    records = history(
        (1001.0, BEGAN), (1002.0 - DAY_S, started(COARSE)), (1003.0 + DAY_S, saved(COARSE)), (1004.0, AGAIN)
    )
    assert [stored.time for stored in true_times(records, 1000.0)] == [1001.0, 1002.0, 1003.0, 1004.0]


def test_the_longest_time_without_a_checkpoint() -> None:
    records = history(
        *[(0.0, BEGAN), (1.0, started(COARSE)), (4.0, saved(COARSE)), (5.0, started(EVAL))],
        *[(9.0, saved(COARSE)), (11.0, model(COARSE))],
    )
    assert longest_unsaved(records) == pytest.approx(5.0)
