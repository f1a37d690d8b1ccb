"""What a fault has cost, from histories made by hand."""

import pytest

from benchmarks.chaos.fault_costs import Fault, fault_costs, longest_unsaved, true_times
from benchmarks.chaos.faults import DAY_S, LIMITS, Kind
from panolog.workers.tasks import COARSE, TaskId
from tests.benchmarks.histories import ONE, ZERO, written


def fault(time: float, kind: Kind, until: float = 0.0) -> Fault:
    return Fault(time, kind, str(kind), until)


BROKEN_NODE = (
    "0 began, 1 started coarse, 4 saved coarse, 6 unread coarse, 8 started coarse, 20 model coarse,"
    " 22 started 0, 23 unread 0, 24 started 1, 30 lost 1, 31 started 1, 50 model 1"
)


@pytest.mark.parametrize(
    ("text", "at", "tasks", "redone", "recovery"),
    [
        (
            "0 began, 1 started 0, 1.5 started 1, 4 saved 0, 9 lost 0, 11 started 0, 20 model 1, 21 model 0",
            fault(6.0, Kind.WORKER),
            (ZERO,),
            2.0,  # since its checkpoint
            5.0,
        ),
        (  # another task takes the place of the dead one
            "0 began, 1 started 0, 5 lost 0, 7 started 1, 30 model 1, 31 started 0",
            fault(4.0, Kind.WORKER),
            (ZERO,),
            3.0,
            3.0,
        ),
        (  # with its driver all running tasks end
            "0 began, 1 started 0, 2 started 1, 3 saved 1, 15 again, 16 started 0, 18 started 1",
            fault(5.0, Kind.DRIVER),
            (ZERO, ONE),
            4.0,
            13.0,
        ),
        # between two tasks it loses its own work, before its first record none
        ("0 began, 2 scores shard, 9 again, 10 started eval", fault(3.0, Kind.DRIVER), (), 1.0, 7.0),
        ("9 began, 12 started coarse", fault(3.0, Kind.DRIVER), (), 0.0, 9.0),
        # a bad node costs each attempt that fails there
        (BROKEN_NODE, fault(2.0, Kind.BADNODE), (COARSE, ZERO), 2.0 + 1.0, 2.0 + 1.0),
        # a node that restarts with another version costs the attempt that it ends as well
        (
            "0 began, 1 started 0, 3 lost 0, 5 started 0, 6 unread 0, 8 started 1, 30 model 1",
            fault(2.0, Kind.VERSION),
            (ZERO,),
            2.0 + 1.0,
            2.0 + 2.0,
        ),
        # what had ended or had not begun loses no work
        ("0 began, 1 started coarse, 9 model coarse", fault(3.0, Kind.WORKER), (), 0.0, 0.0),
        ("3 began, 4 lost coarse, 6 started coarse", fault(2.0, Kind.RAYLET), (COARSE,), 0.0, 4.0),
    ],
)
def test_a_fault_costs_work_that_is_done_again_and_the_time_until_all_is_as_before(
    text: str, at: Fault, tasks: tuple[TaskId, ...], redone: float, recovery: float
) -> None:
    (cost,) = fault_costs(written(text), [at])
    assert cost.tasks == tasks
    assert (cost.redone, cost.recovery, cost.seconds) == (redone, recovery, redone + recovery)


def test_kills_before_the_recovery_count_together() -> None:
    records = written(
        "0 began, 1 started 0, 4 lost 0, 9 again, 12 started 0, 20 saved 0, 24 lost 0, 25 started 0"
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
    records = written(f"0 began, {begun} started coarse, 13 lost coarse, 16 started coarse, 30 model coarse")
    (cost,) = fault_costs(records, [fault(3.0, Kind.HANG), *others])
    assert [one.kind for one in cost.faults] == [Kind.HANG, *(one.kind for one in others)]
    assert (cost.tasks, cost.recovery) == ((COARSE,), 13.0)
    assert cost.allowed == pytest.approx(sum(LIMITS[one.kind].costs for one in cost.faults))


@pytest.mark.parametrize(("kind", "until", "more"), [(Kind.ENOSPC, 8.0, 4.0), (Kind.CLOCK, 0.0, 0.0)])
def test_a_full_disk_and_a_clock_that_jumps_cost_the_silence_around_them(
    kind: Kind, until: float, more: float
) -> None:
    records = written("0 began, 1 started coarse, 3 saved coarse, 9.5 saved coarse")
    (cost,) = fault_costs(records, [fault(4.0, kind, until)])
    assert (cost.tasks, cost.seconds, cost.allowed) == ((), 5.5, LIMITS[kind].costs + more)


def test_jumps_of_the_clock_are_taken_back() -> None:
    records = written(f"1001 began, {1002 - DAY_S} started coarse, {1003 + DAY_S} saved coarse, 1004 again")
    assert [stored.time for stored in true_times(records, 1000.0)] == [1001.0, 1002.0, 1003.0, 1004.0]


def test_the_longest_time_without_a_checkpoint() -> None:
    records = written(
        "0 began, 1 started coarse, 4 saved coarse, 5 started eval, 9 saved coarse, 11 model coarse"
    )
    assert longest_unsaved(records) == pytest.approx(5.0)
