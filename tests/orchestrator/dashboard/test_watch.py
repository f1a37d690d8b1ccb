"""SQLite's locks in the dashboard's process: POSIX drops them when any descriptor of the file is closed."""

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from panolog.orchestrator.dashboard.discovery import RunEntry
from panolog.orchestrator.dashboard.watch import Watch
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed
from panolog.orchestrator.run.thinning import DENSE
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.served import append, progressed, write_whole_run

# Another process that commits, for which it must have the file for itself.
_COMMIT = """
import sqlite3, sys
writer = sqlite3.connect(sys.argv[1], timeout=0)
try:
    with writer:
        writer.execute("INSERT INTO nodes VALUES ('other', 0, '{}')")
except sqlite3.OperationalError as error:
    sys.exit("locked" in str(error))
"""


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return write_whole_run(tmp_path / "run")


@contextmanager
def read_lock(database: Path) -> Iterator[None]:
    """What another thread of the dashboard has while it reads."""
    with closing(sqlite3.connect(database, isolation_level=None)) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT COUNT(*) FROM events").fetchone()
        yield


def locked(database: Path) -> bool:
    """Whether another process is kept from a commit."""
    return bool(subprocess.run([sys.executable, "-c", _COMMIT, str(database)], check=False).returncode)


def test_a_lock_is_lost_when_another_descriptor_of_the_file_is_closed(folder: RunFolder) -> None:
    with read_lock(folder.database):
        assert locked(folder.database)
        folder.database.open("rb").close()
        assert not locked(folder.database)


def test_a_refresh_keeps_the_locks_of_other_threads(folder: RunFolder) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    with read_lock(folder.database):
        watch.refresh()
        watch.refresh_row()
        assert watch.snapshot.row.status != "unreadable"
        assert locked(folder.database)


def test_a_refresh_finds_progress_that_is_not_stored(folder: RunFolder) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    append(folder, *(progressed(COARSE, 1 + number) for number in range(DENSE)))
    version = watch.refresh()
    assert watch.refresh() == version
    append(folder, progressed(COARSE, 99))
    assert watch.refresh() > version
    version = watch.refresh()
    state = watch.history.state.task(COARSE)
    assert state.progress is not None
    assert state.progress.iteration == 99
    append(folder, Noticed(COARSE, "more"))
    assert watch.refresh() > version


def test_a_database_that_is_replaced_is_read_anew(folder: RunFolder, tmp_path: Path) -> None:
    watch = Watch(RunEntry(folder.root.parent, "run"))
    watch.refresh()
    other = write_whole_run(tmp_path / "other")
    append(other, Noticed(COARSE, "of the other"))
    other.database.replace(folder.database)
    watch.refresh()
    assert watch.history.state.notices[-1].message == "of the other"
