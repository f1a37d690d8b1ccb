"""What a run has done: records in its database, and the state that they make.

Everything that a driver writes passes through here, because a disk may be full or out of reach for a while:
the run then waits, shows why, and tries again.
"""

import logging
import math
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from panolog.orchestrator.run.clock import CLOCK, Clock
from panolog.orchestrator.run.disk import why_waiting
from panolog.orchestrator.run.presence import Presence
from panolog.orchestrator.run.records import Record, RunContinued, RunWaiting
from panolog.orchestrator.run.state import OnChange, RunState, apply, ignore, replay
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError

_LOG = logging.getLogger(__name__)
T = TypeVar("T")
_STEP_S = 0.5  # in which a driver that waits looks for requests


@dataclass(frozen=True)
class Patience:
    """How a driver waits for its disk."""

    root: Path  # the run folder
    seconds: float  # between two tries
    presence: Presence
    poll: Callable[[], None] = ignore  # called while it waits; raises KeyboardInterrupt to end that


class Journal:
    """The only way in which a driver changes the state of its run."""

    def __init__(self, database: Database, on_change: OnChange = ignore, clock: Clock = CLOCK) -> None:
        """Args: on_change, called after each record that is stored, and often without one."""
        self.database = database
        self.on_change = on_change
        self.state: RunState = replay(database.milestones())
        self.patience: Patience | None = None  # without one every error is raised at once
        self._clock = clock
        self._since: float | None = None  # Clock.monotonic() from which on the disk has taken nothing

    def record(self, records: Sequence[Record]) -> None:
        """Stores records in one transaction and shows them. Raises sqlite3.Error if that is impossible."""
        stored = self.until_done(lambda: self.database.append(records)) if records else []
        if stored:
            self.state = apply(self.state, stored)
        self.on_change(self.state, stored)

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
        self._since = self._clock.monotonic() if self._since is None else self._since
        if reason != self.state.waiting:
            _LOG.info("%s", reason)
            self.patience.presence.say(reason)
            self.state = replace(self.state, waiting=reason)
            with suppress(sqlite3.Error):  # the database is on the same disk
                stored = self.database.append([RunWaiting(reason)])
                self.state = apply(self.state, stored)
                self.on_change(self.state, stored)
        return True

    def accepted(self) -> None:
        """Records that the disk takes data again."""
        if self._since is None or self.patience is None:
            return
        seconds, self._since = self._clock.monotonic() - self._since, None
        _LOG.info("the disk takes data again, after %.0f s", seconds)
        self.patience.presence.say("")
        self.record([RunContinued(seconds)])

    def _pause(self, patience: Patience) -> None:
        for _ in range(math.ceil(patience.seconds / _STEP_S)):
            patience.poll()
            self.on_change(self.state, ())
            self._clock.sleep(min(_STEP_S, patience.seconds))
