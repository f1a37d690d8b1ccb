"""One run, followed for all who look at it: what has changed is read once, whoever many want to know."""

import json
import sqlite3
import struct
import threading
import time
from pathlib import Path
from typing import Any

from panolog.orchestrator.dashboard import actions
from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.places import Place, open_below, read_below, require_plain
from panolog.orchestrator.dashboard.snapshot import Page, Snapshot
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.records import RunBegan, RunEnded, Stored
from panolog.orchestrator.run.store import read_milestones, read_records
from panolog.orchestrator.views import run_view, summary
from panolog.orchestrator.views.queries import PATIENCE
from panolog.orchestrator.views.timeline import History
from panolog.scene.errors import InputError

# What reading a run folder raises that is of another version, damaged, or made by somebody who means harm.
UNREADABLE = (
    InputError,
    OSError,
    sqlite3.Error,
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)
_BATCH = 5_000  # records that are read one by one; after more the state is read anew
_NEWS = 2_000  # records that are kept for clients that are a little behind
_KEPT = 60.0  # seconds after which a run that nobody looks at is forgotten but for its row
_INFO = 1_000_000  # bytes of run.json at most
_CHANGES = slice(24, 28)  # of the header of an SQLite file: a counter that every commit raises


class Watch:
    """Follows one run. Threads look in turn; anybody may read `snapshot` meanwhile."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.snapshot = Snapshot(row=run_view.unread(place))
        self._news: tuple[Stored, ...] = ()  # the latest records, oldest first
        self.history = History()
        self.resumed: actions.Resumed | None = None
        self._lock = threading.Lock()
        self._asked = 0.0  # time.monotonic() when its page was last wanted
        self._quickly: tuple[Any, ...] | None = None  # what a row depends on, when the last one was made
        self._seen: tuple[Any, ...] | None = None  # all that a page depends on, when it was last made
        self._database: tuple[Any, ...] | None = None  # which file it was, and how often it had changed

    @property
    def running(self) -> bool:
        """Whether a driver was at work on it."""
        return self.snapshot.row.get("status") == "running"

    def look(self) -> int:
        """Reads what is new. Returns the version of what is known; never raises for what a run holds."""
        with self._lock:
            self._asked = time.monotonic()
            return self._try()

    def act(self, action: str, block: int | None) -> None:
        """Asks something of the run. Raises as `actions.act`."""
        with self._lock:
            if self.resumed and self.resumed.starting and not self.running:
                raise InputError("it is about to go on")
            self.resumed = actions.act(self.place, self.history, action, block) or self.resumed

    def look_for_row(self) -> None:
        """The same for the list: it keeps no more than the row of a run at rest that nobody looks at."""
        if not self._lock.acquire(blocking=False):
            return  # somebody is just looking
        try:
            quick = self._quick()
            if quick is None or quick != self._quickly:
                self._try()
                self._quickly = quick
            if not self.running and time.monotonic() - self._asked > _KEPT:
                self._forget()
        finally:
            self._lock.release()

    def _quick(self) -> tuple[Any, ...] | None:
        """What changes whenever the row may; None if that cannot be said."""
        folder = self.place.folder
        try:
            require_plain(self.place)
            status = folder.info.stat()
            return (
                lock.held(folder.lock),
                status.st_mtime_ns,
                status.st_size,
                _stamp(folder.database, folder.root),
            )
        except UNREADABLE:
            return None

    def _try(self) -> int:
        try:
            self._look()
        except UNREADABLE as error:
            self._fail(error)
        return self.snapshot.version

    def _forget(self) -> None:
        """Gives the memory back but for the row; the next look reads it all again."""
        old = self.snapshot
        self.snapshot = Snapshot(version=old.version, row=old.row)
        self.history, self._database, self._seen = History(), None, None
        self._news = ()

    def _look(self) -> None:
        place, folder = self.place, self.place.folder
        require_plain(place)
        running = lock.held(folder.lock)  # asked first: what a driver wrote before it ended is then read
        raw = read_below(folder.info, folder.root, _INFO)
        stamp = _stamp(folder.database, folder.root)
        tasks = self._read(stamp)
        offers = actions.offers(place, self.history, self.resumed, running=running)
        result = {"model": folder.point_cloud.is_file(), "report": folder.report.is_file()}
        seen = (running, raw, stamp, offers, result)
        if seen == self._seen:
            return
        info = json.loads(raw)
        if not isinstance(info, dict):
            raise InputError("run.json holds no object")
        page = self._page(info, running=running) | {"actions": offers, "result": result}
        self._publish(page, tasks, fresh=not self._seen or self._seen[:2] != seen[:2])
        self._seen = seen

    def _read(self, stamp: tuple[Any, ...] | None) -> set[str] | None:
        """Brings the history up to date. Returns the tasks that have changed, None if all may have."""
        path, before = self.place.folder.database, self._database
        if stamp == before and self._seen is not None:
            return set()
        records: list[Stored] = []
        changed: set[str] | None
        known = stamp is not None and before is not None and stamp[0] == before[0] and stamp[1] > before[1]
        if known:
            records = read_records(path, self.history.last, _BATCH, patience=PATIENCE)
        if known and len(records) < _BATCH:
            told = self.history.add(records)
            self._news = (*self._news, *records)[-_NEWS:]
            changed = None if any(isinstance(s.record, RunBegan | RunEnded) for s in records) else told
        else:
            changed = None
            self.history = History.of(read_milestones(path, patience=PATIENCE) if stamp else ())
            self._news = ()
        self._database = stamp
        return changed

    def _page(self, info: Page, *, running: bool) -> Page:
        history, place, now = self.history, self.place, time.time()
        body = summary.as_json(history.state, running=running, now=now)
        estimate = _estimate(place)
        return {
            "id": place.id,
            "name": place.name,
            "path": str(place.folder.root),
            "info": info,
            "summary": body,
            "now": now,
            "progress": run_view.progress_of(history.state, info),
            "eta": run_view.eta_of(history.state, estimate) if running else None,
            "paused": body["paused"],
            "stages": run_view.stages_of(history, info),
            "nodes": run_view.nodes_of(history, running=running),
            "config": run_view.config_of(info),
            "began": history.state.began,
            "latest": history.state.latest,
        }

    def _publish(self, page: Page, tasks: set[str] | None, *, fresh: bool) -> None:
        old, data = self.snapshot, encode(page)
        version = old.version + 1
        whole, changed = version, {}
        if tasks is not None and not fresh and old.page and _extends(page["summary"], old.page["summary"]):
            whole, changed = old.whole, old.tasks | dict.fromkeys(tasks, version)
        row, last = run_view.row_of(page), self.history.last
        self.snapshot = Snapshot(version, row, page, data, whole, changed, self._news, last)

    def _fail(self, error: Exception) -> None:
        """The run cannot be read: a row that says so."""
        line = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        line = " ".join(line.replace(f"{self.place.root}/", "").split())[:300]
        if self.snapshot.row.get("error") == line:
            return
        version = self.snapshot.version + 1
        self._forget()
        row = run_view.unread(self.place) | {"status": "unreadable", "error": line}
        self.snapshot = Snapshot(version, row)


def _extends(new: Page, old: Page) -> bool:
    """Whether a summary has the blocks of an older one and its tasks, and perhaps more tasks."""
    names = {task["name"] for task in new["tasks"]}
    return new["blocks"] == old["blocks"] and all(task["name"] in names for task in old["tasks"])


def _stamp(database: Path, root: Path) -> tuple[Any, ...] | None:
    """Which file the database is, and a number that each commit raises; None if there is none."""
    if not database.exists():
        return None
    handle = open_below(database, root)
    with open(handle, "rb") as file:  # noqa: PTH123  # a descriptor
        header = file.read(_CHANGES.stop)
        status = database.stat()
    if len(header) < _CHANGES.stop:
        return (status.st_ino, 0)
    return (status.st_ino, struct.unpack(">I", header[_CHANGES])[0])


def _estimate(place: Place) -> dict[str, float]:
    """Seconds by stage as they were expected before the start, as far as anything was."""
    try:
        content = json.loads(read_below(place.folder.preflight, place.folder.root, _INFO))
        stages = content["estimate"]["stages"]
        return {str(stage["name"]): float(stage["seconds"] or 0) for stage in stages}
    except UNREADABLE:
        return {}
