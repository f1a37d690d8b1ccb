"""One run, read once for all its clients: only what has changed since the last time is read."""

import sqlite3
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import lock, presence, sql
from panolog.orchestrator.runs.database import as_event, read_milestones, read_news
from panolog.orchestrator.runs.folder import RunFolder, read_json, shown_model
from panolog.orchestrator.runs.records import RunBegan, RunEnded, Stored
from panolog.orchestrator.runs.storage.state import read_state
from panolog.orchestrator.watch.dashboard import actions
from panolog.orchestrator.watch.dashboard.discovery import RunEntry, require_plain
from panolog.orchestrator.watch.dashboard.messages import Results, RunChanges, RunPage, RunRow
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.comparison.reading import DAMAGED
from panolog.orchestrator.watch.views.history import History, without_older_progress
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.pages.findings import findings_version
from panolog.orchestrator.watch.views.preparation import stamp_of, version_of, view_preparation, with_step
from panolog.orchestrator.watch.views.queries import LOCK_TIMEOUT_S
from panolog.orchestrator.watch.views.run_view import RunView, view_run
from panolog.orchestrator.watch.views.summary import Summary
from panolog.scene.errors import InputError

# What reading a run folder raises if it is of another version, damaged, or made to do harm.
UNREADABLE = (InputError, OSError, sqlite3.Error, *DAMAGED)
_BATCH = 5_000  # records that are applied one by one; after more the state is read anew
_RECENT = 2_000  # records that are kept for clients that are a little behind
_UNUSED_S = 60.0  # after which only the row of a run without clients is kept
_AGE_S = 10.0  # after which times of a live run are counted anew, though nothing has happened
_MESSAGE = 200  # records in a message
_ERROR = 300  # characters of an error at most
_CHANGING = RunChanges.model_fields.keys() - {"summary", "tasks"}


@dataclass(frozen=True)
class Snapshot:
    """What is known of a run at one time, encoded once for all its clients."""

    row: RunRow  # its row in the list of runs
    version: int = 0  # grows with each change
    page: RunPage | None = None  # None where it cannot be read: `row.error` says why
    data: bytes = b""  # the page as JSON
    whole: int = 0  # version since which only what `changes` has may differ
    tasks: dict[str, int] = field(default_factory=dict)  # version in which each task changed last
    recent: tuple[Stored, ...] = ()  # the latest records, oldest first
    last: int = 0  # id of the last record
    _changes: dict[int, bytes] = field(default_factory=dict)
    _events: dict[int, bytes] = field(default_factory=dict)

    def changes(self, since: int) -> bytes | None:
        """What has changed since a version, as JSON; None if that needs the whole page."""
        if self.page is None or since < self.whole:
            return None
        if since not in self._changes:
            summary = self.page.summary
            head = summary.model_dump(exclude={"tasks", "blocks"})
            tasks = [task for task in summary.tasks if self.tasks.get(task.name, 0) > since]
            rest = {key: getattr(self.page, key) for key in _CHANGING}
            self._changes[since] = encode(rest | {"summary": head, "tasks": tasks})
        return self._changes[since]

    def events(self, since: int) -> bytes | None:
        """The records after one as JSON, see `latest_events`; None if there are none."""
        recent = [stored for stored in self.recent if stored.id > since]
        if not recent:
            return None
        if since not in self._events:
            self._events[since] = encode({"events": latest_events(recent)})
        return self._events[since]


def latest_events(records: Sequence[Stored]) -> list[dict[str, Any]]:
    """Records for the pages, newest first: of progress only the latest of each task."""
    return [as_event(stored) for stored in without_older_progress(records)[: -_MESSAGE - 1 : -1]]


class Watch:
    """Follows one run. One thread at a time refreshes it; any thread may read `snapshot` meanwhile."""

    def __init__(self, entry: RunEntry) -> None:
        self.entry = entry
        self.snapshot = Snapshot(RunRow.unread(entry))
        self._recent: tuple[Stored, ...] = ()  # the latest records, oldest first
        self.history = History()
        self.resumed: actions.Driver | None = None
        self._lock = threading.Lock()
        self._used = 0.0  # time.monotonic() when its page was last requested
        self._row_stamp: tuple[Any, ...] | None = None  # what a row depends on, when the last one was made
        self._page_stamp: tuple[Any, ...] | None = None  # all that a page depends on, when it was last made
        self._database: tuple[Any, ...] | None = None  # `_database_stamp` when it was read

    @property
    def database(self) -> Path:
        """The database of the run."""
        return self.entry.folder.database

    @property
    def running(self) -> bool:
        """Whether a driver works on it."""
        return self.snapshot.row.status == "running"

    def refresh(self) -> int:
        """Reads what is new. Returns the version of the snapshot; never raises for what a run holds."""
        with self._lock:
            self._used = time.monotonic()
            return self._try()

    def act(self, action: str, block: int | None, node: str | None) -> None:
        """Does what a page requests. Raises as `actions.perform`."""
        with self._lock:
            if self.resumed and self.resumed.poll() is None and not self.running:
                raise InputError("it is being resumed")
            self.resumed = actions.perform(self.entry, self.history, action, block, node) or self.resumed

    def refresh_row(self) -> None:
        """Reads the run anew for the list: of a run at rest without clients only the row is kept."""
        if not self._lock.acquire(blocking=False):
            return  # another thread is reading it
        try:
            stamp = self._stamp_of_row()
            if stamp is None or stamp != self._row_stamp:
                self._try()
                self._row_stamp = stamp
            if not self.running and time.monotonic() - self._used > _UNUSED_S:
                self._forget()
        finally:
            self._lock.release()

    def _stamp_of_row(self) -> tuple[Any, ...] | None:
        """A value that changes whenever the row may; None if the run cannot be read."""
        folder = self.entry.folder
        try:
            require_plain(self.entry)
            return (
                running := lock.held(folder.lock),
                presence.waiting(folder.presence),
                _clock(running=running),
                version_of(folder.info),
                stamp_of(folder),
                _database_stamp(folder.database),
            )
        except UNREADABLE:
            return None

    def _try(self) -> int:
        try:
            self._read_run()
        except UNREADABLE as error:
            self._fail(error)
        return self.snapshot.version

    def _forget(self) -> None:
        """Frees all but the row; the next refresh reads it again."""
        old = self.snapshot
        self.snapshot = Snapshot(old.row, old.version)
        self.history, self._database, self._page_stamp = History(), None, None
        self._recent = ()

    def _read_run(self) -> None:
        entry, folder = self.entry, self.entry.folder
        require_plain(entry)
        running = lock.held(folder.lock)  # before the records, so that all that an ended driver wrote is read
        stamp = _database_stamp(folder.database)
        tasks = self._read_records(stamp)
        available = actions.available_actions(entry, self.history, self.resumed, running=running)
        result = Results(
            model=folder.point_cloud.is_file(),
            report=folder.report.is_file(),
            view=folder.page.is_file(),
            in_3d=_in_3d(folder),
            map=folder.known_plan.is_file(),
            outline=None if folder.plan.is_file() else version_of(folder.outline),
            exposure=version_of(folder.exposure),
            findings=findings_version(folder),
        )
        waiting = presence.waiting(folder.presence) if running else ""
        mirror = read_state(folder.mirror, running=running)
        store = mirror.brief if mirror else ""
        files, clock = stamp_of(folder), _clock(running=running)
        info = version_of(folder.info)  # before the file is read
        page_stamp = (running, info, stamp, available, result, waiting, files, store, clock)
        if page_stamp == self._page_stamp:
            return
        view = self._view(read_json(folder), waiting, store, running=running)
        shown: dict[str, Any] = dict(view) | {"id": entry.id, "name": entry.name, "path": str(folder.root)}
        page = RunPage(**shown, actions=available, result=result)
        self._publish(page, tasks, fresh=not self._page_stamp or self._page_stamp[:2] != page_stamp[:2])
        self._page_stamp = page_stamp

    def _read_records(self, stamp: tuple[Any, ...] | None) -> set[str] | None:
        """Brings the history up to date. Returns the tasks that have changed, None if all may have."""
        path, before = self.entry.folder.database, self._database
        if stamp == before and self._page_stamp is not None:
            return set()
        records: list[Stored] = []
        changed: set[str] | None
        known = stamp is not None and before is not None and _follows(stamp, before)
        if known:
            records = read_news(path, self.history.last, _BATCH, timeout_s=LOCK_TIMEOUT_S)
        if known and len(records) < _BATCH:
            touched = self.history.add(records)
            self._recent = (*self._recent, *records)[-_RECENT:]
            changed = None if any(isinstance(s.record, RunBegan | RunEnded) for s in records) else touched
        else:
            changed = None
            self.history = History.of(read_milestones(path, timeout_s=LOCK_TIMEOUT_S) if stamp else ())
            self._recent = ()
        self._database = stamp
        return changed

    def _view(self, info: dict[str, Any], waiting: str, store: str, *, running: bool) -> RunView:
        folder = self.entry.folder
        usages = queries.usages(folder.database) if running and folder.database.exists() else {}
        prepared = view_preparation(folder, self.history.state, running=running)
        history = replace(self.history, state=with_step(self.history.state, prepared))
        return view_run(
            history,
            info,
            running=running,
            root=folder.root,
            usages=usages,
            waiting=waiting,
            preparation=prepared,
            store=store,
        )

    def _publish(self, page: RunPage, tasks: set[str] | None, *, fresh: bool) -> None:
        old, data = self.snapshot, encode(page)
        version = old.version + 1
        whole, changed = version, {}
        if tasks is not None and not fresh and old.page and _extends(page.summary, old.page.summary):
            whole, changed = old.whole, old.tasks | dict.fromkeys(tasks, version)
        cover = queries.cover(self.database, evaluated=page.summary.metrics is not None)
        row, last = RunRow.of_page(page, cover), self.history.last
        self.snapshot = Snapshot(row, version, page, data, whole, changed, self._recent, last)

    def _fail(self, error: Exception) -> None:
        """Publishes a row with the error: the run cannot be read."""
        line = error_line(error, self.entry.folder.root)
        if self.snapshot.row.error == line:
            return
        version = self.snapshot.version + 1
        self._forget()
        row = RunRow.unread(self.entry).model_copy(update={"status": "unreadable", "error": line})
        self.snapshot = Snapshot(row, version)


def _clock(*, running: bool) -> int:
    """A number that grows every _AGE_S: the times of a live run change also while it records nothing."""
    return int(time.monotonic() / _AGE_S) if running else 0


def _in_3d(folder: RunFolder) -> bool:
    """Whether a 3D view has a model to show."""
    try:
        shown_model(folder)
    except InputError:
        return False
    return True


def _extends(new: Summary, old: Summary) -> bool:
    """Whether a summary has the blocks of an older one and its tasks, and perhaps more tasks."""
    names = {task.name for task in new.tasks}
    return new.blocks == old.blocks and all(task.name in names for task in old.tasks)


def error_line(error: Exception, root: Path) -> str:
    """An error of a run folder in one line, without the path of the folder `root`."""
    line = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return " ".join(line.replace(f"{root}/", "").split())[:_ERROR]


def _database_stamp(database: Path) -> tuple[Any, ...] | None:
    """Which file the database is, and values that each commit changes; None if there is none."""
    return sql.version(database, timeout_s=LOCK_TIMEOUT_S) if database.exists() else None


def _follows(stamp: tuple[Any, ...], before: tuple[Any, ...]) -> bool:
    """Whether a database is the one of before, perhaps with more in it."""
    return stamp[0] == before[0] and all(
        new is not None and new >= old for new, old in zip(stamp, before, strict=True) if old is not None
    )
