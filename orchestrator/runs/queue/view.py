"""A queue as commands and the dashboard show it, and what both can do with an entry."""

import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import Entry, State
from panolog.orchestrator.runs.queue.runner import lock_of, log_of, sole_runner
from panolog.orchestrator.runs.queue.shares import describe

_LEFT = "interrupted"  # how a running entry is shown while no runner is at work and nothing of it is alive


@dataclass(frozen=True)
class QueueView:
    folder: Path
    runner: bool  # one is at work
    entries: tuple[Entry, ...]
    alive: frozenset[int]  # running entries of which a process is alive

    def label(self, entry: Entry) -> str:
        left = entry.state == State.RUNNING and not self.runner and entry.id not in self.alive
        return _LEFT if left else str(entry.state)

    def reason(self, entry: Entry) -> str:
        """Why it has failed or was stopped; what it waits for, while a runner is at work."""
        return entry.reason if self.runner or not entry.open else ""

    def as_json(self) -> dict[str, Any]:
        return {
            "queue": str(self.folder),
            "runner": self.runner,
            "entries": [self._entry(entry) for entry in self.entries],
        }

    def _entry(self, entry: Entry) -> dict[str, Any]:
        command = entry.command
        return {
            "id": entry.id,
            "state": str(entry.state),
            "label": self.label(entry),
            "run": str(command.run),
            "command": shlex.join(["panolog", "run", *command.first]),
            "folder": str(command.folder),
            "log": str(log_of(self.folder, entry.id)) if entry.starts else None,
            "added": entry.added,
            "began": entry.began,
            "ended": entry.ended,
            "starts": entry.starts,
            "exit_code": entry.code,
            "reason": self.reason(entry),
            "needs": None if command.needs is None else asdict(command.needs),
            "share": None if entry.share is None else asdict(entry.share),
        }

    def lines(self) -> Iterator[str]:
        rows = [(str(entry.id), self.label(entry), str(entry.command.run)) for entry in self.entries]
        width = max((len(id) for id, _, _ in rows), default=0)
        for (id, label, run), entry in zip(rows, self.entries, strict=True):
            more = self.reason(entry) or (describe(entry) if entry.open else "")
            yield f"{id:>{width}}  {label:<11}  {run}" + (f"  ({more})" if more else "")
        if not rows:
            yield f"the queue {self.folder} is empty"
        elif not self.runner and any(entry.open for entry in self.entries):
            yield "no runner is at work: `panolog queue run` starts one"


def view_queue(queue: Queue, *, removed: bool = False) -> QueueView:
    """A queue as it is now. Args: removed, show removed entries too."""
    entries = tuple(queue.entries(removed=removed))
    alive = frozenset(it.id for it in entries if it.state == State.RUNNING and _alive(it))
    return QueueView(queue.folder, lock.held(lock_of(queue.folder)), entries, alive)


def remove_entry(queue: Queue, id: int) -> None:
    """Removes an entry, also one that a runner has left running, if nothing of it is alive any more.

    Raises QueueError if there is none of that number, or it is running.
    """
    entry = queue.entry(id)
    dead = entry.state == State.RUNNING and not _alive(entry)
    if not dead or lock.held(lock_of(queue.folder)):
        queue.remove(id)
        return
    with sole_runner(queue.folder):  # else one may start it now
        queue.remove(id, dead=True)


def _alive(entry: Entry) -> bool:
    return processes.alive(entry.process) or lock.held(RunFolder(entry.command.run).lock)
