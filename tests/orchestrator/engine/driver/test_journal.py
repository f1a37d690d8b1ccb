"""A reader that has run.db locked: records wait, and the run continues."""

import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from panolog.orchestrator.engine.driver import journal as journal_module
from panolog.orchestrator.engine.driver.journal import Backlog, Journal
from panolog.orchestrator.runs.records import CheckpointSaved, ModelSaved, Noticed, Progressed, RunBegan
from panolog.orchestrator.runs.state import Status
from panolog.orchestrator.runs.store import Database, read_records
from panolog.workers.tasks import COARSE

# A reader that begins to read and does not end.
_READER = """
import sqlite3, sys
reader = sqlite3.connect(sys.argv[1], isolation_level=None)
reader.execute("BEGIN")
reader.execute("SELECT COUNT(*) FROM events").fetchone()
print("reads", flush=True)
sys.stdin.read()
"""
SAVED = CheckpointSaved(COARSE, 2, "p", 1)
DONE = ModelSaved(COARSE, "coarse/model.ply", 1, 1, 2, 1.0)


@contextmanager
def locked(path: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process reads the database in the context."""
    command = [sys.executable, "-c", _READER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reads\n"
        try:
            yield reader
        finally:
            reader.kill()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(journal_module, "_TRY_S", 0.01)
    monkeypatch.setattr(journal_module, "TIMEOUT_S", 0.1)
    return tmp_path / "run.db"


def test_records_wait_and_keep_their_order_and_times(path: Path) -> None:
    with closing(Database(path)) as database:
        shown: list[object] = []
        journal = Journal(database, lambda _, news: shown.extend(item.record for item in news))
        journal.record([RunBegan("host", 1, resumed=False)])
        with locked(path) as reader:
            journal.record([Progressed(COARSE, 1, 2, 1.0)])
            journal.record([SAVED])
            assert journal.state.task(COARSE).checkpoint == 2
            assert len(read_records(path)) == 1
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                journal.record([DONE])  # its checkpoint is removed next
            assert journal.state.status(COARSE) != Status.DONE
        journal.record([])
        assert len(read_records(path)) == 4
        journal.record([DONE])
    _, progress, notice, saved, done = read_records(path)
    assert (progress.record, saved.record) == (Progressed(COARSE, 1, 2, 1.0), SAVED)
    assert done.record == DONE
    assert isinstance(notice.record, Noticed)
    assert f"(process {reader.pid}): records wait in memory" in notice.record.message
    assert progress.time == notice.time < saved.time < done.time
    assert [type(record) for record in shown] == [type(item.record) for item in read_records(path)]


def test_only_so_many_wait(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MOST", 3)
    with closing(Database(path)) as database, locked(path):
        waiting = Backlog(database)
        waiting.store([SAVED])
        waiting.store([SAVED])
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            waiting.store([SAVED])
        assert len(waiting) == 3  # with the notice


def test_ctrl_c_ends_the_wait(path: Path) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with closing(Database(path)) as database, locked(path), pytest.raises(KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            Backlog(database).store([DONE], wait_s=60)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert read_records(path) == []
