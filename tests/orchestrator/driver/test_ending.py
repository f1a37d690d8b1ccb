"""However a driver ends, the run's history has its end and why."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.run.records import Outcome, RunBegan, RunEnded
from panolog.orchestrator.run.store import Database, read_records
from panolog.scene.errors import ClusterLostError, InputError, RunError, RunLockedError
from panolog.workers.events import Event, Progress
from panolog.workers.specs import TaskSpec
from tests.orchestrator.fakes import Harness


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
    tmp_path: Path, error: BaseException, raised: type[BaseException], reason: str, transient: bool
) -> None:
    def script(spec: TaskSpec) -> Iterator[Event]:
        yield Progress(spec.task, 1, 2, 3.0)
        raise error

    harness = Harness(tmp_path)
    with pytest.raises(raised):
        harness.drive(script)
    (ended,) = harness.records(RunEnded)
    assert (ended.outcome, ended.reason, ended.transient) == (Outcome.FAILED, reason, transient)
    assert ("test_ending.py" in ended.detail) == reason.startswith("internal error")
    assert harness.state.transient == transient
    assert harness.drive(resumed=True).outcome == "done"
    assert not harness.state.transient


def test_a_driver_whose_run_another_has_taken_over_ends_without_a_record(tmp_path: Path) -> None:
    """Where locks do not work."""
    harness = Harness(tmp_path)

    def script(spec: TaskSpec) -> Iterator[Event]:
        yield Progress(spec.task, 1, 2, 3.0)
        with closing(Database(harness.folder.database)) as database:
            database.append([RunBegan("another", 2, resumed=True)])
        yield Progress(spec.task, 2, 2, 3.0)

    with pytest.raises(RunLockedError, match="another driver has taken the run over"):
        harness.drive(script)
    *_, last = read_records(harness.folder.database)
    assert last.record == RunBegan("another", 2, resumed=True)
    assert harness.drive(resumed=True).outcome == "done"
