"""What a run has done: records in its database, and the state that they make.

Everything that a driver writes passes through here, because a disk may be full or out of reach for a while:
the run then waits, shows why, and tries again.
"""

import logging
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.clock import CLOCK, Clock, Steady
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.presence import Presence, why_waiting
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Noticed,
    PreviewSaved,
    Progressed,
    Record,
    RunContinued,
    RunWaiting,
    Stored,
    TaskStarted,
    Transferred,
    ViewEvaluated,
)
from panolog.orchestrator.runs.sql import TIMEOUT_S
from panolog.orchestrator.runs.state import OnChange, RunState, apply, ignore, replay
from panolog.scene.errors import RunError

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
MOST = 10_000  # records that wait in memory, of a kilobyte each
_CAN_WAIT = (
    Progressed,
    CheckpointSaved,
    PreviewSaved,
    Transferred,
    ViewEvaluated,
    Noticed,
    TaskStarted,
    RunWaiting,
    RunContinued,
)
_TRY_S = 0.5  # of one try, in which no signal is handled
_STEP_S = 0.5  # in which a driver that waits looks for requests


@dataclass(frozen=True)
class Patience:
    """How a driver waits for its disk."""

    root: Path  # the run folder
    seconds: float  # between two tries
    presence: Presence
    poll: Callable[[], None] = ignore  # called while it waits; raises KeyboardInterrupt to end that


class Backlog:
    """Records on their way to the database, which a reader may have locked: they keep order and times.

    Most can wait in memory until it is free: after a driver that ends before, the next repeats a little.
    Others cannot, because what follows relies on them: after a model's record, for example, its checkpoint is
    removed.
    """

    def __init__(self, database: Database, clock: Clock = CLOCK) -> None:
        self._database = database
        self._clock = clock
        self._waiting: list[tuple[float, Record]] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def store(self, records: Sequence[Record], *, wait_s: float = 0.0) -> list[Stored]:
        """Stores records, and before them those that wait; returns the former.

        Where the database is locked, they wait, with the id 0; those that cannot wait get so many seconds.
        Raises as `Database.store`; then those that waited before still do.
        """
        now = self._clock.time()
        new = [(now, record) for record in records]
        can_wait = len(self) + len(new) <= MOST and all(isinstance(it, _CAN_WAIT) for it in records)
        last = self._clock.monotonic() + wait_s
        while True:
            try:
                stored = self._database.store([*self._waiting, *new], timeout_s=_TRY_S)
            except sqlite3.OperationalError as error:
                if "locked" not in str(error) or (not can_wait and self._clock.monotonic() >= last):
                    raise
                if can_wait:
                    return self._keep(new, now)
            else:
                if self._waiting:
                    _LOG.info("run.db is free again: %d records were stored", len(self))
                shown, self._waiting = len(self), []
                return stored[shown:]

    def _keep(self, new: list[tuple[float, Record]], now: float) -> list[Stored]:
        """Keeps records in memory, the first time with a notice. Returns what is to be shown."""
        if not self._waiting:
            holders = ", ".join(lock.holders(self._database.path)) or "another program"
            message = f"{self._database.path} is locked by {holders}: records wait in memory until it is free"
            _LOG.warning("%s", message)
            new = [*new, (now, Noticed(None, message))]
        self._waiting += new
        return [Stored(0, time, record) for time, record in new]


class Journal:
    """The only way in which a driver changes the state of its run."""

    def __init__(self, database: Database, on_change: OnChange = ignore, clock: Clock | None = None) -> None:
        """Args: on_change, called after each record that is stored, often without; clock, the driver's."""
        self.database = database
        self.on_change = on_change
        self.state: RunState = replay(database.milestones())
        self.patience: Patience | None = None  # without one every error is raised at once
        self.clock = clock or Steady()
        self._backlog = Backlog(database, self.clock)
        self.why = ""  # nothing can run, see `explain`
        self._idle = 0.0  # Clock.monotonic() of that
        self._since: float | None = None  # Clock.monotonic() from which on the disk has taken nothing
        self.again = 0.0  # Clock.monotonic() at which to try again what it has refused

    def record(self, records: Sequence[Record]) -> None:
        """Stores records in one transaction, see `Backlog`, and shows them.

        Raises sqlite3.Error if that is impossible.
        """
        stored = self.until_done(lambda: self._store(records)) if records or self._backlog else []
        if stored:
            self.state = apply(self.state, stored)
        self.on_change(self.state, stored)

    def explain(self, why: str) -> None:
        """Records that nothing can run, and why, or with "" that something does; if that is new."""
        if why == self.why:
            return
        now = self.clock.monotonic()
        self._idle = self._idle if self.why else now
        self.why = why
        self.record([RunWaiting(why) if why else RunContinued(now - self._idle)])

    def show_step(self, step: str) -> None:
        """Shows what the driver does before its first task; in the database is only that it has begun."""
        self.state = replace(self.state, step=step)
        self.on_change(self.state, ())

    def _store(self, records: Sequence[Record]) -> list[Stored]:
        return self._backlog.store(records, wait_s=TIMEOUT_S if self.patience is None else 0.0)

    def until_done(self, action: Callable[[], T], size: int = 0) -> T:
        """The result of an action that writes; repeats it for as long as the disk takes nothing.

        Args: size, bytes that it writes, where that is known.
        Raises KeyboardInterrupt if the run is to stop meanwhile, and what `action` raises for other reasons.
        """
        waited = False
        while True:
            try:
                result = action()
            except (OSError, sqlite3.Error, RunError) as error:
                if self.patience is None or not self.refused(error, size):
                    raise
                self._pause(self.patience)
                waited = True
            else:
                if waited:
                    self.accepted()
                return result

    def refused(self, error: BaseException, size: int = 0) -> bool:
        """Shows that the run waits, if an error has a reason that may pass; else returns False."""
        if self.patience is None or not (reason := why_waiting(error, self.patience.root, size)):
            return False
        now = self.clock.monotonic()
        self._since = now if self._since is None else self._since
        self.again = now + self.patience.seconds
        if reason != self.state.waiting:
            _LOG.info("%s", reason)
            self.patience.presence.say(reason)
            self.state = replace(self.state, waiting=reason)
            with suppress(sqlite3.Error):  # the database is on the same disk
                stored = self._store([RunWaiting(reason)])
                self.state = apply(self.state, stored)
                self.on_change(self.state, stored)
        return True

    def accepted(self) -> None:
        """Records that the disk takes data again."""
        if self._since is None or self.patience is None:
            return
        seconds, self._since = self.clock.monotonic() - self._since, None
        _LOG.info("the disk takes data again, after %.0f s", seconds)
        self.patience.presence.say("")
        self.record([RunContinued(seconds)])

    def _pause(self, patience: Patience) -> None:
        while (left := self.again - self.clock.monotonic()) > 0:
            patience.poll()
            self.on_change(self.state, ())
            self.clock.sleep(min(_STEP_S, left))
