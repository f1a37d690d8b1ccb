"""RUN/run.db: every record in order, in SQLite. The driver writes it, any process reads it.

The journal is a rollback journal, not a WAL: `run.db` alone is complete after every commit, so that a plain
copy of it, also on read-only media or a network share, can be read. Readers take all rows of a query at once
and so never hold the driver up for long.
"""

import json
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from shutil import copyfile
from typing import Any

from panolog.orchestrator.run.clock import CLOCK, Clock
from panolog.orchestrator.run.records import (
    CheckpointSaved,
    Progressed,
    Record,
    Stored,
    from_json,
    task_name,
    to_json,
)
from panolog.scene.errors import RunFolderError

_TIMEOUT_S = 60.0  # seconds to wait for another connection's lock
_LATEST = (Progressed.__name__, CheckpointSaved.__name__)  # of these only the last of a task matters to state
PICTURES = "type IN ('PreviewSaved', 'ViewEvaluated')"  # found by an index
_MILESTONE = "type NOT IN ('Progressed', 'CheckpointSaved', 'PreviewSaved', 'ViewEvaluated')"
_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, time REAL NOT NULL,
    task TEXT NOT NULL, type TEXT NOT NULL, payload TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS latest_progress ON events (task, id) WHERE type = 'Progressed';
CREATE INDEX IF NOT EXISTS latest_checkpoint ON events (task, id) WHERE type = 'CheckpointSaved';
CREATE INDEX IF NOT EXISTS state ON events (id) WHERE {_MILESTONE};
CREATE INDEX IF NOT EXISTS pictures ON events (type, task, id) WHERE {PICTURES};
CREATE TABLE IF NOT EXISTS metrics (
    task TEXT NOT NULL, name TEXT NOT NULL,
    iteration INTEGER NOT NULL, time REAL NOT NULL, value REAL NOT NULL);
CREATE INDEX IF NOT EXISTS metric_series ON metrics (task, name, iteration);
CREATE TABLE IF NOT EXISTS nodes (node TEXT PRIMARY KEY, time REAL NOT NULL, usage TEXT NOT NULL);
"""
# The last rows of one type: hops from task to task in the index, which the condition on `type` selects.
_LAST = """
SELECT id, time, type, payload FROM events WHERE id IN (
    WITH RECURSIVE tasks(name) AS (
        SELECT MIN(task) FROM events WHERE type = '{0}'
        UNION ALL
        SELECT (SELECT MIN(task) FROM events WHERE type = '{0}' AND task > name) FROM tasks
        WHERE name IS NOT NULL)
    SELECT (SELECT MAX(id) FROM events WHERE type = '{0}' AND task = name) FROM tasks WHERE name IS NOT NULL)
"""
# What state needs of a run: thousands of rows instead of millions.
_STATE = " UNION ALL ".join(
    [
        f"SELECT id, time, type, payload FROM events WHERE {_MILESTONE}",
        *(_LAST.format(kind) for kind in _LATEST),
    ]
)
_STATE += " ORDER BY id"
_TABLES = "SELECT COUNT(*) FROM sqlite_master"  # none if a driver was killed before its first commit
_SERIES = ("rate", "loss", "psnr", "gaussians", "memory")


class Database:
    """The writer. One for each run folder, opened by the process that has the run's lock."""

    def __init__(self, path: Path, clock: Clock = CLOCK) -> None:
        """Opens or makes the database; one that a kill left half made is made whole.

        Raises InputError if the file is no database or cannot be written.
        """
        self._clock = clock
        try:
            self._connection = sqlite3.connect(path, timeout=_TIMEOUT_S)
            self._connection.executescript(_SCHEMA)
            (last,) = self._connection.execute("SELECT COALESCE(MAX(id), 0) FROM events").fetchone()
        except sqlite3.Error as error:
            raise RunFolderError(f"{path} cannot be opened as the database of a run: {error}") from error
        self._last = int(last)

    def append(self, records: Sequence[Record]) -> list[Stored]:
        """Adds records in one transaction; they are on disk when it returns."""
        now = self._clock.time()
        stored = [Stored(self._last + 1 + i, now, record) for i, record in enumerate(records)]
        self._last += len(stored)  # first: if it is interrupted in between, they are not used again
        with self._connection:
            self._connection.executemany(
                "INSERT INTO events (id, time, task, type, payload) VALUES (?, ?, ?, ?, ?)",
                [
                    (s.id, s.time, task_name(s.record), type(s.record).__name__, to_json(s.record))
                    for s in stored
                ],
            )
            self._connection.executemany(
                "INSERT INTO metrics (task, name, iteration, time, value) VALUES (?, ?, ?, ?, ?)",
                [row for s in stored if isinstance(s.record, Progressed) for row in _series(s.record, now)],
            )
        return stored

    def put_usage(self, node: str, usage: Mapping[str, Any]) -> None:
        """Keeps what a machine does now, in place of what it did before. Args: usage, values for JSON."""
        row = (node, self._clock.time(), json.dumps(usage, allow_nan=False))
        with self._connection:
            self._connection.execute("INSERT OR REPLACE INTO nodes VALUES (?, ?, ?)", row)

    def milestones(self) -> list[Stored]:
        """The records that `state.replay` needs, in order."""
        return _stored(self._connection.execute(_STATE))

    def close(self) -> None:
        """Lets go of the file."""
        self._connection.close()


def read_milestones(path: Path, *, timeout_s: float = _TIMEOUT_S) -> list[Stored]:
    """The records that `state.replay` needs, in order: no outdated progress or checkpoints, no pictures.

    Raises InputError if the file is missing or is not a run's database.
    """
    return _stored(query(path, _STATE, timeout_s=timeout_s))


def read_records(
    path: Path, after: int = 0, limit: int = 1000, *, timeout_s: float = _TIMEOUT_S
) -> list[Stored]:
    """At most `limit` records that follow the one with the id `after`. Raises as `read_milestones`."""
    sql = "SELECT id, time, type, payload FROM events WHERE id > ? ORDER BY id LIMIT ?"
    return _stored(query(path, sql, (after, limit), timeout_s=timeout_s))


def _series(record: Progressed, now: float) -> Iterator[tuple[str, str, int, float, float]]:
    values = {name: getattr(record, name) for name in _SERIES}
    values |= {f"rate/{name}": value for name, value in record.rates.items()}
    for name, value in values.items():
        if value is not None:
            yield task_name(record), name, record.iteration, now, value


def _stored(rows: Iterable[tuple[Any, ...]]) -> list[Stored]:
    return [Stored(id, time, from_json(kind, payload)) for id, time, kind, payload in rows]


def query(
    path: Path, sql: str, values: Sequence[Any] | Mapping[str, Any] = (), *, timeout_s: float = _TIMEOUT_S
) -> list[tuple[Any, ...]]:
    """All rows of a query on a database that may be empty, live, dead, or a read-only copy.

    Args: timeout_s, seconds to wait for the driver's lock. Raises as `read_milestones`.
    """
    if not path.is_file():
        raise RunFolderError(f"{path.parent} is not a run folder: it has no {path.name}")
    journal = path.with_name(path.name + "-journal")
    try:
        try:
            return _rows(path, sql, values, timeout_s)
        except sqlite3.OperationalError as error:
            if "readonly" not in str(error) or not journal.is_file():
                raise
        # A driver was killed in the middle of a commit. Only a writer may roll it back: make a copy whole.
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / path.name
            copyfile(path, copy)
            copyfile(journal, copy.with_name(journal.name))
            with closing(sqlite3.connect(copy)) as connection:
                connection.execute(_TABLES)
            return _rows(copy, sql, values, timeout_s)
    except sqlite3.DatabaseError as error:
        raise RunFolderError(f"{path} cannot be read as the database of a run: {error}") from error


def _rows(
    path: Path, sql: str, values: Sequence[Any] | Mapping[str, Any], timeout_s: float
) -> list[tuple[Any, ...]]:
    uri = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True, timeout=timeout_s)) as connection:
        (tables,) = connection.execute(_TABLES).fetchone()
        return connection.execute(sql, values).fetchall() if tables else []
