"""The run as the follower reads it: piece by piece from run.db, without being in the driver's way."""

import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from panolog.orchestrator.runs import presence
from panolog.orchestrator.runs.database import read_milestones, read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.money.records import BudgetNear
from panolog.orchestrator.runs.records import Outcome, RunBegan, RunEnded, Stored
from panolog.orchestrator.runs.sql import version
from panolog.orchestrator.runs.state import RunState, Status, apply, replay
from panolog.orchestrator.watch.follower.board import ALL, News
from panolog.orchestrator.watch.follower.notifications import (
    Losses,
    Notification,
    end_of,
    near_of,
    run_id,
    stall_of,
)
from panolog.scene.errors import RunFolderError

_LIMIT = 1000  # records read at once
_LOCK_S = 5.0  # to wait for the driver's lock
WAITING_S = 60.0  # for which a run may wait for its disk before it counts as stalled


@dataclass
class Watcher:
    """Reads one run. Args: stalled, seconds without a record after which a live run counts as stalled."""

    folder: RunFolder
    stalled: float
    state: RunState = field(default_factory=RunState)
    run: str = ""
    _losses: Losses = field(default_factory=Losses)
    _turn: Stored | None = None  # the latest RunBegan or RunEnded
    _began: int = 0  # id of the latest RunBegan
    _last: int = 0  # id of the latest record
    _version: tuple[Any, ...] = ()  # of the database, the state of nodes aside
    _since: float = field(default_factory=time.monotonic)  # when that has changed
    _stalls: dict[str, Notification] = field(default_factory=dict)
    _near: dict[str, Notification] = field(default_factory=dict)  # limits

    def look(self) -> bool:
        """Reads what is new. Returns whether anything is; a database that cannot be read now has no news."""
        with suppress(RunFolderError, OSError):
            *new, _ = version(self.folder.database, timeout_s=_LOCK_S)
            if tuple(new) == self._version:
                return False
            if not self._version or new[0] != self._version[0]:
                self._begin()
            else:
                while records := read_records(self.folder.database, self._last, _LIMIT, timeout_s=_LOCK_S):
                    self.state = apply(self.state, records)
                    self._add(records)
            self._version, self._since = tuple(new), time.monotonic()
            return True
        return False

    def _begin(self) -> None:
        records = read_milestones(self.folder.database, timeout_s=_LOCK_S)
        self.state, self.run = replay(records), run_id(records)
        self._losses, self._turn, self._began, self._last = Losses(), None, 0, 0
        self._near.clear()
        self._add(records)

    def _add(self, records: list[Stored]) -> None:
        self._losses.add(records)
        self.run = self.run or run_id(records)
        for item in records:
            self._last = item.id
            if isinstance(item.record, BudgetNear):
                near = near_of(item, item.record, self.run, self.name)
                self._near[near.id] = near
            if isinstance(item.record, RunBegan | RunEnded):
                self._turn = item
                self._began = item.id if isinstance(item.record, RunBegan) else self._began

    def stall(self) -> bool:
        """Notes that nothing happens in a live run after its preflight. Returns whether that is new."""
        silent = time.monotonic() - self._since
        why = self.state.waiting or presence.waiting(self.folder.presence)
        early = not self.state.prepared  # the scene is made without records
        if early or silent < (WAITING_S if why else self.stalled) or self._paused:
            return False
        found = stall_of(silent, why, self._last, time.time(), self.run, self.name)
        new = found.id not in self._stalls
        self._stalls.setdefault(found.id, found)
        return new

    @property
    def name(self) -> str:
        """The name of the run folder."""
        return self.folder.root.resolve().name

    @property
    def _paused(self) -> bool:
        """Whether a user has paused all that could happen."""
        found = {task.status for task in self.state.tasks.values()}
        return Status.PAUSED in found and Status.RUNNING not in found

    def news(self, *, ended: bool = False, left: bool = False) -> News:
        """What is known. Args: ended, no more will be read; left, no driver is at work on the run."""
        if not self.run or not self.folder.info.is_file() or not (self.state.prepared or left):
            return News(ended=ended)
        found = [
            *self._losses.notifications(self.run, self.name),
            *self._stalls.values(),
            *self._near.values(),
        ]
        found.sort(key=lambda notification: (notification.time, notification.id))
        if left and (end := end_of(self.state, self._turn, self.run, self.name)):
            found.append(end)
        done = self.state.outcome in (Outcome.DONE, Outcome.LIMITED)
        return News(
            self.run,
            self._began,
            tuple(found),
            settled(self.state),
            ended,
            self.state.outcome,
            (self.state.metrics or {}) if done else {},
        )


def settled(state: RunState) -> dict[str, int]:
    """Up to which iteration the curves of each task stay as they are: a checkpoint, or its end.

    What follows the latest checkpoint is repeated if the attempt fails.
    """
    found = {}
    for task in state.tasks.values():
        until = ALL if task.status == Status.DONE else task.checkpoint or 0
        if until:
            found[str(task.id)] = until
    return found
