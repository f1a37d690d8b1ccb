"""QUEUE/queue.db: the entries of a queue in SQLite, which several commands may use at once.

The journal is a WAL, so that `list` and the dashboard never wait for a command that writes: the folder must
be on a disk of this machine. Every change is one transaction that checks the state that it relies on.
"""

import json
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs.clock import CLOCK, Clock
from panolog.orchestrator.runs.database import transaction
from panolog.orchestrator.runs.queue.entries import Command, Entry, Identity, Needs, Share, State
from panolog.scene.errors import QueueError
from panolog.scene.files import user_folder

DATABASE = "queue.db"
_VERSION = 2  # of the schema
_MOST = 10_000  # entries that are not removed
_LASTING_S = 600.0  # after which the kill of a process is none in a row with those before
_TIMEOUT_S = 10.0  # to wait for other commands
_COLUMNS = (
    "id, position, state, run, first, later, folder, added, began, ended, boot, pid, started, starts, losses,"
    " code, reason, needs, share"
)
_STATES = ", ".join(f"'{state}'" for state in State)
_SCHEMA = f"""
CREATE TABLE entries (
    id INTEGER PRIMARY KEY AUTOINCREMENT, position INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ({_STATES})),
    run TEXT NOT NULL, first TEXT NOT NULL, later TEXT NOT NULL, folder TEXT NOT NULL,
    added REAL NOT NULL, began REAL, ended REAL, boot TEXT, pid INTEGER, started INTEGER,
    starts INTEGER NOT NULL DEFAULT 0, losses INTEGER NOT NULL DEFAULT 0, code INTEGER,
    reason TEXT NOT NULL DEFAULT '');
CREATE INDEX by_position ON entries (position) WHERE state != 'removed';
"""
# By the version that they make. Rows of version 1 have no needs.
_CHANGES = {
    1: _SCHEMA,
    2: "ALTER TABLE entries ADD COLUMN needs TEXT; ALTER TABLE entries ADD COLUMN share TEXT",
}


def default_folder() -> Path:
    """The user's queue. Raises QueueError for a user without a home."""
    if given := os.environ.get("PANOLOG_QUEUE"):
        return Path(given).absolute()
    folder = user_folder("XDG_STATE_HOME", ".local/state")
    if folder is None:
        raise QueueError("there is no home folder for the queue: give --queue DIR, or set PANOLOG_QUEUE")
    return folder / "queue"


class Queue:
    """An open queue. A thread that uses it must be the one that has opened it."""

    def __init__(self, folder: Path, clock: Clock = CLOCK, *, make: bool = True) -> None:
        """Opens a queue, and makes it unless `make` is false.

        Raises QueueError if the folder has none, cannot be used, or is of another version.
        """
        self.folder = folder
        self._clock = clock
        path = folder / DATABASE
        if not make and not path.is_file():
            raise QueueError(f"{folder}: has no queue yet; `panolog queue add` makes one")
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise QueueError(f"{folder}: cannot be created: {error.strerror}") from error
        try:
            self._connection = sqlite3.connect(path.resolve(), timeout=_TIMEOUT_S, isolation_level=None)
        except sqlite3.Error as error:
            raise _unusable(path, error) from error
        try:
            self._prepare()
        except (sqlite3.Error, QueueError) as error:
            self._connection.close()
            raise error if isinstance(error, QueueError) else _unusable(path, error) from error

    def _prepare(self) -> None:
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = FULL")  # a start is on disk before the run begins
        version = self._version()
        if version < _VERSION:
            with transaction(self._connection):
                for made in range(self._version() + 1, _VERSION + 1):  # another command may have been quicker
                    for statement in filter(str.strip, _CHANGES[made].split(";")):
                        self._connection.execute(statement)
                    self._connection.execute(f"PRAGMA user_version = {made}")
        if version > _VERSION:
            raise QueueError(
                f"{self.folder}: the queue is of a newer PanoLOG (version {version}, this one knows"
                f" {_VERSION}); use that one, or give another --queue DIR"
            )

    def _version(self) -> int:
        return int(self._connection.execute("PRAGMA user_version").fetchone()[0])

    def close(self) -> None:
        self._connection.close()

    def add(self, command: Command) -> int:
        """Adds a run at the end and returns its number.

        Raises QueueError if the queue has this run, or is full.
        """
        with transaction(self._connection):
            live = (State.WAITING, State.RUNNING)
            for entry in self._select("run = ? AND state IN (?, ?)", (str(command.run), *live)):
                raise QueueError(
                    f"{command.run}: is in the queue already, as number {entry.id} ({entry.state});"
                    " give another -o"
                )
            (count, last) = self._connection.execute(
                "SELECT COUNT(*) FILTER (WHERE state != 'removed'), IFNULL(MAX(position), 0) FROM entries"
            ).fetchone()
            if count >= _MOST:
                raise QueueError(
                    f"{self.folder}: has {_MOST:,} entries; remove old ones with `panolog queue remove`"
                )
            words = (json.dumps(command.first), json.dumps(command.later))
            row = (last + 1, State.WAITING, str(command.run), *words, str(command.folder), self._clock.time())
            needs = json.dumps(command.needs and asdict(command.needs))
            number = self._connection.execute(
                "INSERT INTO entries (position, state, run, first, later, folder, added, needs)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (*row, needs),
            ).lastrowid
        assert number is not None  # of an INSERT
        return number

    def entries(self, *, removed: bool = False) -> list[Entry]:
        """All entries in order, without removed ones unless those are wanted too."""
        return self._select("1" if removed else "state != 'removed'")

    def entry(self, id: int) -> Entry:
        """One entry. Raises QueueError if there is none of that number, or it was removed."""
        for entry in self._select("id = ? AND state != 'removed'", (id,)):
            return entry
        raise QueueError(f"the queue has no entry {id}; `panolog queue list` shows all")

    def running(self) -> list[Entry]:
        """The entries that have begun and whose end is not known, in order."""
        return self._select("state = 'running'")

    def next(self) -> Entry | None:
        """The first that waits; None if none does."""
        return next(iter(self._select("state = 'waiting' ORDER BY position, id LIMIT 1", order=False)), None)

    def move(self, id: int, before: int | None) -> None:
        """Moves a waiting entry before another one, or to the end. Raises QueueError if one does not wait."""
        with transaction(self._connection):
            self._require(id, State.WAITING, doing="moved")
            if before is not None:
                self._require(before, State.WAITING, doing="a place to move to")
            if id == before:
                return
            waiting = self._select("state = 'waiting'")
            places = [entry.position for entry in waiting]
            order = [entry.id for entry in waiting if entry.id != id]
            order.insert(len(order) if before is None else order.index(before), id)
            rows = zip(places, order, strict=True)
            self._connection.executemany("UPDATE entries SET position = ? WHERE id = ?", rows)

    def remove(self, id: int, *, dead: bool = False) -> None:
        """Removes an entry; its run folder stays. Raises QueueError if it is running.

        Args: dead, the caller has found that nothing of a running entry is alive, and no runner is at work.
        """
        with transaction(self._connection):
            if self.entry(id).state == State.RUNNING and not dead:
                run = self.entry(id).command.run
                raise QueueError(f"entry {id} is running; stop it first: `panolog stop {run}`")
            self._update(id, state=State.REMOVED)

    def retry(self, id: int, needs: Needs | None = None) -> None:
        """Lets an entry that has failed or was stopped wait again, last. Raises QueueError for any other.

        Args: needs, instead of those that it had.
        """
        with transaction(self._connection):
            self._require(id, State.FAILED, State.STOPPED, doing="tried again")
            if needs is not None:
                self._update(id, needs=json.dumps(asdict(needs)))
            (last,) = self._connection.execute("SELECT MAX(position) FROM entries").fetchone()
            changes = {"position": last + 1, "ended": None, "code": None, "reason": "", "losses": 0}
            self._update(id, state=State.WAITING, **changes)

    def claim(self, id: int) -> Entry | None:
        """A waiting entry, which is running from now on; None if it does not wait any more."""
        with transaction(self._connection):
            for _ in self._select("id = ? AND state = 'waiting'", (id,)):
                self._update(id, state=State.RUNNING, began=self._clock.time(), reason="")
                return self.entry(id)
        return None

    def note(self, id: int, reason: str) -> None:
        """Notes what an entry waits for; does nothing for one that has ended or was removed meanwhile."""
        with transaction(self._connection):
            for _ in self._select("id = ? AND state IN ('waiting', 'running')", (id,)):
                self._update(id, reason=reason)

    def forget_waits(self) -> None:
        """Removes all notes of what entries wait for."""
        with transaction(self._connection):
            self._connection.execute("UPDATE entries SET reason = '' WHERE state IN ('waiting', 'running')")

    def launched(self, id: int, process: Identity, share: Share | None = None) -> None:
        """Notes process and share of a running entry, before anything of the run begins."""
        with transaction(self._connection):
            starts = self._require(id, State.RUNNING, doing="started").starts + 1
            changes = {"boot": process.boot, "pid": process.pid, "started": process.started, "reason": ""}
            held = None if share is None else json.dumps(asdict(share))
            self._update(id, starts=starts, began=self._clock.time(), share=held, **changes)

    def end(self, id: int, state: State, code: int | None, reason: str) -> None:
        """Notes how a running entry has ended."""
        with transaction(self._connection):
            self._require(id, State.RUNNING, doing="ended")
            self._update(id, state=state, code=code, reason=reason, ended=self._clock.time(), share=None)

    def lose(self, id: int) -> int:
        """Counts that the process of a running entry was killed; returns how often in a row, each soon."""
        with transaction(self._connection):
            entry = self._require(id, State.RUNNING, doing="lost")
            lasted = self._clock.time() - (entry.began or 0.0)
            losses = 1 if lasted > _LASTING_S else entry.losses + 1
            self._update(id, losses=losses)
        return losses

    def _require(self, id: int, *states: State, doing: str) -> Entry:
        entry = self.entry(id)
        if entry.state not in states:
            names = " or ".join(states)
            raise QueueError(f"entry {id} is {entry.state}: only what is {names} can be {doing}")
        return entry

    def _update(self, id: int, **values: Any) -> None:
        columns = ", ".join(f"{name} = ?" for name in values)
        self._connection.execute(f"UPDATE entries SET {columns} WHERE id = ?", (*values.values(), id))

    def _select(self, condition: str, values: Sequence[Any] = (), *, order: bool = True) -> list[Entry]:
        sql = f"SELECT {_COLUMNS} FROM entries WHERE {condition}" + " ORDER BY position, id" * order
        try:
            return [_entry(row) for row in self._connection.execute(sql, values).fetchall()]
        except (ValueError, TypeError, KeyError) as error:
            raise QueueError(f"{self.folder / DATABASE}: is damaged: {error}; move it away") from error


@contextmanager
def opened(folder: Path, *, make: bool = True) -> Iterator[Queue]:
    """A queue while the context lasts. Raises as `Queue`, and QueueError for any failure of its database."""
    queue = Queue(folder, make=make)
    try:
        yield queue
    except sqlite3.Error as error:
        raise _unusable(folder / DATABASE, error) from error
    finally:
        queue.close()


def _unusable(path: Path, error: sqlite3.Error) -> QueueError:
    way = "" if isinstance(error, sqlite3.OperationalError) else "; move it away for a new queue"
    return QueueError(f"{path}: cannot be used as a queue: {error}{way}")


def _entry(row: Sequence[Any]) -> Entry:
    id, position, state, run, first, later, folder, added, began, ended, boot, pid, started, *rest = row
    starts, losses, code, reason, needs, share = rest
    words = tuple(json.loads(first))
    command = Command(Path(run), words, tuple(json.loads(later)), Path(folder), _needs(needs, words))
    process = None if boot is None else Identity(boot, pid, started)
    held = None if share is None else _share(json.loads(share))
    return Entry(
        *(id, position, State(state), command, added, began, ended, process, starts, losses, code, reason),
        share=held,
    )


def _needs(text: str | None, words: tuple[str, ...]) -> Needs | None:
    if text is None:  # version 1
        return None if "--address" in words else Needs()
    values = json.loads(text)
    return None if values is None else Needs(**values)


def _share(values: dict[str, Any]) -> Share:
    lists = {name: None if values[name] is None else tuple(values[name]) for name in ("gpus", "cores")}
    return Share(**lists, memory=values["memory"])
