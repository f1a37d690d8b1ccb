"""RUN/run.db: every record in order, in SQLite. The driver writes it, any process reads it.

The journal is a rollback journal, not a WAL: `run.db` alone is complete after every commit, so that a plain
copy of it can be read, also on read-only media. Of progress only a part is stored, by the rule of `thinning`;
the latest of each task is kept in place.
"""

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import thinning
from panolog.orchestrator.runs.clock import CLOCK, Clock
from panolog.orchestrator.runs.money.records import OfRun
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    Failure,
    Leaving,
    ModelSaved,
    Noticed,
    Outcome,
    Part,
    Progressed,
    Record,
    RunBegan,
    Stored,
    task_name,
)
from panolog.orchestrator.runs.sql import TIMEOUT_S, has_table, query, require_own_journal, unusable
from panolog.scene.errors import RunFolderError, RunLockedError
from panolog.workers.tasks import TaskId

_TYPES: dict[str, type[Any]] = {kind.__name__: kind for kind in Record.__args__}
_USAGE_S = 0.5  # to wait for the locks of readers before usage, which is replaced soon
_LATEST = (Progressed.__name__, CheckpointSaved.__name__)  # of these only the last of a task matters to state
PICTURES = "type IN ('PreviewSaved', 'ViewEvaluated')"  # found by an index
EVENT = "SELECT id, time, type, payload FROM events"
MILESTONE = "type NOT IN ('Progressed', 'CheckpointSaved', 'PreviewSaved', 'ViewEvaluated')"
_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY, time REAL NOT NULL,
    task TEXT NOT NULL, type TEXT NOT NULL, payload TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS latest_progress ON events (task, id) WHERE type = 'Progressed';
CREATE INDEX IF NOT EXISTS latest_checkpoint ON events (task, id) WHERE type = 'CheckpointSaved';
CREATE INDEX IF NOT EXISTS state ON events (id) WHERE {MILESTONE};
CREATE INDEX IF NOT EXISTS pictures ON events (type, task, id) WHERE {PICTURES};
CREATE INDEX IF NOT EXISTS drivers ON events (id) WHERE type = 'RunBegan';
CREATE TABLE IF NOT EXISTS latest (
    task TEXT PRIMARY KEY, id INTEGER NOT NULL, time REAL NOT NULL, payload TEXT NOT NULL);
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
_STATE = " UNION ALL ".join([f"{EVENT} WHERE {MILESTONE}", *(_LAST.format(kind) for kind in _LATEST)])
# The latest progress of tasks that is not stored as an event.
_PROGRESS = """
SELECT id, time, 'Progressed', payload FROM latest WHERE NOT EXISTS (
    SELECT 1 FROM events WHERE events.id = latest.id)
"""
_SERIES = ("rate", "loss", "psnr", "gaussians", "memory")


@dataclass(frozen=True)
class _Stream:
    stored: int  # how many records
    time: float  # of the last one, seconds since the epoch
    latest: Stored | None = None  # if it was not stored

    def keeps(self, time: float) -> bool:
        """Whether a record of that time is stored; also after the clock was set back."""
        return abs(time - self.time) >= thinning.interval(self.stored)


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All or nothing of what is written in the context, after what any other connection writes."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")


class Database:
    """The writer. One for each run folder, opened by the process that has the run's lock."""

    def __init__(self, path: Path, clock: Clock = CLOCK) -> None:
        """Opens or makes the database; one that a kill left half made is made whole.

        Raises InputError if the file is no database or cannot be written.
        """
        self.path = path
        self._clock = clock
        self._last: int | None = None  # id of the last record
        self._began: int | None = None  # id of the RunBegan of this driver
        self._streams: dict[TaskId, _Stream] = {}
        require_own_journal(path)
        try:
            self._connection = sqlite3.connect(path.resolve(), timeout=TIMEOUT_S, isolation_level=None)
            self._connection.executescript(_SCHEMA)
        except sqlite3.Error as error:
            raise unusable(path, error) from error

    def append(self, records: Sequence[Record]) -> list[Stored]:
        """Adds records of now. Returns and raises as `store`."""
        now = self._clock.time()
        return self.store([(now, record) for record in records])

    def store(self, records: Sequence[tuple[float, Record]], *, timeout_s: float = TIMEOUT_S) -> list[Stored]:
        """Adds records, each with its time, in one transaction; they are on disk when it returns.

        Args: timeout_s, seconds to wait for the locks of readers.
        Of progress all is returned, but only what `thinning` keeps is stored.
        Raises RunLockedError if another driver has taken the run over; sqlite3.Error, and nothing is stored,
        if that is impossible.
        """
        with self._transaction(timeout_s):
            if self._last is None:
                self._last = self._read_last()
            first = self._last + 1
            self._last += 2 * len(records)  # at once: if it is interrupted, none is used again
            numbers, streams = iter(range(first, self._last + 1)), dict[TaskId, _Stream]()
            added: list[Stored] = []
            for time, record in records:
                if isinstance(record, ModelSaved) and (end := self._stream(record.task, streams).latest):
                    added.append(self._insert(replace(end, id=next(numbers)), streams, keep=True))
                added.append(self._insert(Stored(next(numbers), time, record), streams))
        self._last = added[-1].id if added else first - 1
        self._streams |= streams
        began = [item.id for item in added if isinstance(item.record, RunBegan)]
        self._began = began[-1] if began else self._began
        return added

    def require_own(self) -> None:
        """Raises RunLockedError if another driver has taken the run over, which its lock should prevent."""
        (newest,) = self._connection.execute("SELECT MAX(id) FROM events WHERE type = 'RunBegan'").fetchone()
        if self._began is not None and newest != self._began:
            raise RunLockedError(
                f"{self.path.parent}: another driver has taken the run over, as locks do not work on this "
                "file system; this one ends"
            )

    @contextmanager
    def _transaction(self, timeout_s: float) -> Iterator[None]:
        """All or nothing of what is written in the context, if the run is still this driver's."""
        self._connection.execute(f"PRAGMA busy_timeout = {round(1000 * timeout_s)}")
        with transaction(self._connection):
            self.require_own()
            yield

    def _read_last(self) -> int:
        sql = "SELECT MAX((SELECT IFNULL(MAX(id), 0) FROM events), (SELECT IFNULL(MAX(id), 0) FROM latest))"
        return int(self._connection.execute(sql).fetchone()[0])

    def _insert(self, item: Stored, streams: dict[TaskId, _Stream], *, keep: bool = False) -> Stored:
        """Adds a record, unless it is progress that is not kept. Args: streams, those that have changed."""
        record, text = item.record, to_json(item.record)
        if isinstance(record, Progressed):
            stream = self._stream(record.task, streams)
            keep = keep or stream.keeps(item.time)
            new = _Stream(stream.stored + 1, item.time) if keep else replace(stream, latest=item)
            streams[record.task] = new
            values = (task_name(record), item.id, item.time, text)
            self._connection.execute("INSERT OR REPLACE INTO latest VALUES (?, ?, ?, ?)", values)
            if not keep:
                return item
            self._connection.executemany(
                "INSERT INTO metrics VALUES (?, ?, ?, ?, ?)", _series(record, item.time)
            )
        row = (item.id, item.time, task_name(record), type(record).__name__, text)
        self._connection.execute(
            "INSERT INTO events (id, time, task, type, payload) VALUES (?, ?, ?, ?, ?)", row
        )
        return item

    def _stream(self, task: TaskId, changed: Mapping[TaskId, _Stream]) -> _Stream:
        """The progress of a task: as changed, as known, or as read from the disk."""
        if (known := changed.get(task) or self._streams.get(task)) is not None:
            return known
        of_task = "FROM events WHERE type = 'Progressed' AND task = ?"
        sql = f"SELECT COUNT(*), (SELECT time {of_task} ORDER BY id DESC LIMIT 1) {of_task}"
        count, time = self._connection.execute(sql, (str(task), str(task))).fetchone()
        return _Stream(count, time or 0.0)

    def put_usage(self, node: str, usage: Mapping[str, Any]) -> None:
        """Keeps what a machine does now, in place of what it did before, unless a reader has a lock.

        Args: usage, values for JSON.
        """
        row = (node, self._clock.time(), json.dumps(usage, allow_nan=False))
        try:
            with self._transaction(_USAGE_S):
                self._connection.execute("INSERT OR REPLACE INTO nodes VALUES (?, ?, ?)", row)
        except sqlite3.OperationalError as error:
            if "locked" not in str(error):
                raise

    def milestones(self) -> list[Stored]:
        """The records that `state.replay` needs, in order. Raises InputError if the file is damaged."""
        try:
            return _stored(self._connection.execute(f"{_STATE} UNION ALL {_PROGRESS} ORDER BY id"))
        except sqlite3.OperationalError:  # a lock, or the disk
            raise
        except sqlite3.DatabaseError as error:
            raise unusable(self.path, error) from error

    def close(self) -> None:
        self._connection.close()


def read_milestones(path: Path, *, timeout_s: float = TIMEOUT_S) -> list[Stored]:
    """The records that `state.replay` needs, in order: no outdated progress or checkpoints, no pictures.

    Raises InputError if the file is missing or is not a run's database.
    """
    more = f"UNION ALL {_PROGRESS}" if has_table(path, "latest", timeout_s=timeout_s) else ""
    return _stored(query(path, f"{_STATE} {more} ORDER BY id", timeout_s=timeout_s))


def as_event(stored: Stored) -> dict[str, Any]:
    """A record with its place in the history, for other programs."""
    head = {"id": stored.id, "time": stored.time, "type": type(stored.record).__name__}
    return head | fields_of(stored.record)


def read_records(
    path: Path, after: int = 0, limit: int = 1000, *, timeout_s: float = TIMEOUT_S
) -> list[Stored]:
    """At most `limit` stored records that follow the id `after`. Raises as `read_milestones`."""
    sql = f"{EVENT} WHERE id > ? ORDER BY id LIMIT ?"
    return _stored(query(path, sql, (after, limit), timeout_s=timeout_s))


def read_news(path: Path, after: int, limit: int, *, timeout_s: float = TIMEOUT_S) -> list[Stored]:
    """The records after one, with each task's latest progress, stored or not. Raises as `read_milestones`."""
    if not has_table(path, "latest", timeout_s=timeout_s):
        return read_records(path, after, limit, timeout_s=timeout_s)
    sql = f"SELECT * FROM ({EVENT} WHERE id > :after ORDER BY id LIMIT :limit) UNION ALL {_PROGRESS}"
    sql += " AND id > :after ORDER BY id LIMIT :limit"
    return _stored(query(path, sql, {"after": after, "limit": limit}, timeout_s=timeout_s))


def _series(record: Progressed, now: float) -> Iterator[tuple[str, str, int, float, float]]:
    values = {name: getattr(record, name) for name in _SERIES}
    values |= {f"rate/{name}": value for name, value in record.rates.items()}
    for name, value in values.items():
        if value is not None:
            yield task_name(record), name, record.iteration, now, value


def _stored(rows: Iterable[tuple[Any, ...]]) -> list[Stored]:
    return [Stored(id, time, from_json(kind, payload)) for id, time, kind, payload in rows]


def to_json(record: Record) -> str:
    """The fields of a record; its type is stored in a column of its own."""
    return json.dumps(fields_of(record), default=vars, allow_nan=False, separators=(",", ":"))


def from_json(kind: str, text: str) -> Record:
    """The inverse of `to_json`. Raises InputError for a record that this version does not know."""
    try:
        fields: Any = {n: tuple(v) if isinstance(v, list) else v for n, v in json.loads(text).items()}
        name = fields.pop("task")
        if not issubclass(_TYPES[kind], OfRun):
            fields["task"] = _subject(kind, name)
        match kind:
            case "PlanSaved":
                fields["blocks"] = tuple(BlockPlan(**block) for block in fields["blocks"])
                fields["passes"] = tuple(map(tuple, fields.get("passes", ())))
            case "TaskFailed":
                fields["kind"] = Failure(fields.get("kind", Failure.ERROR))
            case "NodeLeaving":
                fields["kind"] = Leaving(fields["kind"])
            case "RunEnded":
                fields["outcome"] = Outcome(fields["outcome"])
        record: Record = _TYPES[kind](**fields)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"the record {kind} {text:.200} is not of this PanoLOG's format: {error}"
        raise RunFolderError(reason) from error
    return record


def fields_of(record: Record) -> dict[str, Any]:
    """The values of a record by name, its task as text."""
    return vars(record) | {"task": task_name(record)}


def _subject(kind: str, name: str) -> TaskId | Part | None:
    if kind == Noticed.__name__ and name in ("", *Part):
        return Part(name) if name else None
    return TaskId.parse(name)
