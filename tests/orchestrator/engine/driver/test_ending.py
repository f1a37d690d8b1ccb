"""However a driver ends, the run's history has its end and why."""

import sqlite3
from contextlib import closing

import pytest

from panolog.orchestrator.runs.records import Outcome, RunEnded
from panolog.orchestrator.runs.store import Database, read_records
from panolog.scene.errors import ClusterLostError, InputError, RunError, RunLockedError
from panolog.workers.events import Progress
from panolog.workers.tasks import COARSE
from tests.orchestrator.fakes import Harness, begins
from tests.orchestrator.history import AGAIN


@pytest.mark.parametrize(
    ("error", "raised", "reason", "transient"),
    [
        (ValueError("bad"), ValueError, "internal error: ValueError: bad", True),
        (SystemExit(3), SystemExit, "internal error: SystemExit: 3", True),
        (ClusterLostError("Ray: no head"), ClusterLostError, "Ray: no head", True),
        (OSError("EIO"), RunError, "EIO", True),
        (sqlite3.OperationalError("locked"), RunError, "locked", True),
        (InputError("a.jpg is truncated"), InputError, "a.jpg is truncated", False),
    ],
    ids=str,
)
def test_an_error_of_the_pool_leaves_its_record(
    harness: Harness, error: BaseException, raised: type[BaseException], reason: str, transient: bool
) -> None:
    with pytest.raises(raised):
        harness.drive(begins(COARSE, Progress(COARSE, 1, 2, 3.0), error))
    (ended,) = harness.records(RunEnded)
    assert (ended.outcome, ended.reason, ended.transient) == (Outcome.FAILED, reason, transient)
    assert ("fakes.py" in ended.detail) == reason.startswith("internal error")
    assert harness.state.transient == transient
    assert harness.drive(resumed=True).outcome == "done"
    assert not harness.state.transient


def test_a_driver_whose_run_another_has_taken_over_ends_without_a_record(harness: Harness) -> None:
    """Where locks do not work."""

    def take_over() -> None:
        with closing(Database(harness.folder.database)) as database:
            database.append([AGAIN])

    steps = Progress(COARSE, 1, 2, 3.0), take_over, Progress(COARSE, 2, 2, 3.0)
    with pytest.raises(RunLockedError, match="another driver has taken the run over"):
        harness.drive(begins(COARSE, *steps))
    *_, last = read_records(harness.folder.database)
    assert last.record == AGAIN
    assert harness.drive(resumed=True).outcome == "done"
