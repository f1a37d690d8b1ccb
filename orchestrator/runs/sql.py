"""Queries of a database that may be empty, live, left by a killed driver, or a read-only copy.

A driver that is killed in the middle of a commit leaves a journal. A reader of the same user rolls it back,
as a writer does; of another user's folder a copy is read.
"""

import os
import sqlite3
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from shutil import copyfile
from typing import Any

from panolog.orchestrator.runs import lock
from panolog.scene.errors import RunFolderError

TIMEOUT_S = 60.0  # to wait for the driver's lock
_STARTING_S = 2.0  # in which a driver that starts has rolled a journal back
_POLL_S = 0.05
_TABLES = "SELECT COUNT(*) FROM sqlite_master"  # none if a driver was killed before its first commit
_MAGIC = bytes.fromhex("d9d505f920a163d7")  # ends a journal that names another: sqlite.org/fileformat2.html
# What helps a run whose database is lost or damaged.
WAYS_OUT = "put back a copy of it, or start a new run in another folder; `panolog export` works without it"
# Whatever is committed raises one of these ids, or sets a later time.
_VERSION = {
    "events": "SELECT MAX(id) FROM events",
    "latest": "SELECT MAX(id) FROM latest",
    "nodes": "SELECT MAX(time) FROM nodes",
}


def query(
    path: Path, sql: str, values: Sequence[Any] | Mapping[str, Any] = (), *, timeout_s: float = TIMEOUT_S
) -> list[tuple[Any, ...]]:
    """All rows of a query. Args: timeout_s, seconds to wait for the driver's lock.

    Raises InputError if the file is missing or is not a run's database.
    """
    with reading(path, timeout_s=timeout_s) as connection:
        (tables,) = connection.execute(_TABLES).fetchone()
        return connection.execute(sql, values).fetchall() if tables else []


def has_table(path: Path, name: str, *, timeout_s: float = TIMEOUT_S) -> bool:
    """Whether there is a table, which versions before may not have made. Raises as `query`."""
    sql = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?"
    return bool(query(path, sql, (name,), timeout_s=timeout_s))


def version(path: Path, *, timeout_s: float = TIMEOUT_S) -> tuple[Any, ...]:
    """Which file a database is, and values that change with each commit. Raises as `query`.

    SQLite reads it: who opens and closes the file otherwise drops all locks that SQLite holds on it in this
    process (POSIX, `man 2 fcntl`).
    """
    status = path.stat()
    if _hot(path, timeout_s) and not _roll_back(path, timeout_s):  # a copy is made only if this has changed
        return (status.st_ino, None, status.st_size, status.st_mtime_ns)
    with reading(path, timeout_s=timeout_s) as connection:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
        sql = ", ".join(f"({_VERSION[name] if name in tables else 'NULL'})" for name in _VERSION)
        return (status.st_ino, *connection.execute(f"SELECT {sql}").fetchone())


@contextmanager
def reading(path: Path, *, timeout_s: float = TIMEOUT_S) -> Iterator[sqlite3.Connection]:
    """A connection that can read the database. Raises as `query`, also for what is raised with it."""
    if not path.is_file():
        raise RunFolderError(f"{path.parent} is not a run folder: it has no {path.name}")
    try:
        if _hot(path, timeout_s) and not _roll_back(path, timeout_s):
            connection = _copied(path)
        else:
            connection = _connected(path, "ro", timeout_s)
        with closing(connection):
            yield connection
    except sqlite3.DatabaseError as error:
        raise unusable(path, error) from error


def unusable(path: Path, error: sqlite3.Error) -> RunFolderError:
    """What to raise for a database that SQLite cannot use. Its line says what helps where it is damaged."""
    ways = "" if isinstance(error, sqlite3.OperationalError) else f": {WAYS_OUT}"
    return RunFolderError(f"{path}: cannot be used as the database of a run ({error}){ways}")


def require_own_journal(path: Path) -> None:
    """Raises InputError if the journal of a database names another one: SQLite would remove that file.

    No run has such a journal, so only a folder that is made to do harm.
    """
    journal = path.with_name(path.name + "-journal")
    try:
        with journal.open("rb") as file:
            file.seek(-len(_MAGIC), os.SEEK_END)
            end = file.read()
    except OSError:  # there is none, or it is empty
        return
    if end == _MAGIC:
        raise RunFolderError(f"{journal}: is not the journal of a run; remove it")


def _connected(path: Path, mode: str, timeout_s: float) -> sqlite3.Connection:
    uri = f"{path.resolve().as_uri()}?mode={mode}"  # SQLite refuses `..` at the root
    return sqlite3.connect(uri, uri=True, timeout=timeout_s)


def _hot(path: Path, timeout_s: float) -> bool:
    """Whether there is a journal that must be rolled back before anything can be read."""
    if not path.with_name(path.name + "-journal").is_file():
        return False
    try:
        with closing(_connected(path, "ro", timeout_s)) as connection:
            connection.execute(_TABLES).fetchone()
    except sqlite3.OperationalError as error:
        if "readonly" not in str(error):
            raise
        return True
    return False


def _roll_back(path: Path, timeout_s: float) -> bool:
    """Rolls a journal back if that is this process's business. Raises InputError as `require_own_journal`."""
    require_own_journal(path)
    journal = path.with_name(path.name + "-journal")
    last = time.monotonic() + _STARTING_S
    while lock.held(path.with_name("lock")) and time.monotonic() < last:
        if not _hot(path, timeout_s):
            return True
        time.sleep(_POLL_S)
    try:
        owners = {path.stat().st_uid, journal.stat().st_uid}
        if lock.held(path.with_name("lock")) or owners != {os.geteuid()}:
            return False
        with closing(_connected(path, "rw", timeout_s)) as connection:
            connection.execute(_TABLES).fetchone()
    except FileNotFoundError:  # another reader was quicker
        return True
    except sqlite3.OperationalError:  # the folder cannot be written
        return False
    return not _hot(path, timeout_s)


def _copied(path: Path) -> sqlite3.Connection:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        for suffix in ("", "-journal"):
            copyfile(path.with_name(path.name + suffix), copy.with_name(path.name + suffix))
        require_own_journal(copy)
        connection = sqlite3.connect(copy)
        connection.execute(_TABLES).fetchone()
    return connection
