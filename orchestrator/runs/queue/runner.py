"""`panolog queue run`: starts the runs of a queue one after another, or side by side.

Each run is the supervised command, a child of the runner, which the kernel stops when the runner ends: as
after Ctrl-C, with checkpoints. What was running then stays so in the database, and the next runner resumes it
first, but only when nothing of an earlier start is left. A child waits at a gate until its identity is in the
database: boot of the machine, number, and moment of its start. While a driver has the lock of the run folder,
the run is alive, however it was started. Runs start strictly in order: one that waits for its share of the
machine keeps those after it waiting; one that needs more than the machine has fails.
"""

import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.control import state_of
from panolog.orchestrator.runs.folder import RunFolder, command_line
from panolog.orchestrator.runs.machines.children import bound_to_parent, signals_blocked
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import Entry, Share, State
from panolog.orchestrator.runs.queue.shares import Capacity, NeverFitsError, environment
from panolog.orchestrator.runs.records import Outcome
from panolog.scene.errors import QueueError, RunLockedError, last_line

PROGRAM = (sys.executable, "-m", "panolog.orchestrator.cli")
# The shell waits for a line, then becomes the program: with the same number and moment of start.
_GATE = ("/bin/sh", "-c", 'read -r _ && exec "$@" < /dev/null', "panolog-queue")
_POLL_S = 0.5  # between two looks at new entries and at processes that are not children
_FULL_S = 10.0  # between two tries to write while the disk of the queue is full
_LOSSES = 5  # supervisors in a row that may be killed before a run counts as failed
_LOG = 10_000_000  # bytes of a log from which on it begins anew
_TAIL = 4_000  # bytes of a log that are searched for its last line
_INTERRUPTED = 130  # exit code of what was stopped
_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class Limits:
    at_once: int = 1  # runs side by side
    forever: bool = False  # wait for new entries when none is left
    program: tuple[str, ...] = PROGRAM  # that takes the words of an entry
    machine: Capacity = field(default_factory=Capacity.own)


@contextmanager
def sole_runner(folder: Path) -> Iterator[None]:
    """Makes this the only runner of a queue while the context lasts. Raises QueueError if there is one."""
    try:
        with lock.hold(lock_of(folder)):
            yield
    except RunLockedError as error:
        raise QueueError(
            f"{folder}: another `panolog queue run` is at work on this queue; it takes new entries by itself"
        ) from error


def lock_of(folder: Path) -> Path:
    """Held by the runner of a queue."""
    return folder / "runner"


def log_of(folder: Path, id: int) -> Path:
    """The output of an entry's run."""
    return folder / "logs" / f"{id}.log"


def run_queue(queue: Queue, limits: Limits, say: Callable[[str], None]) -> int:
    """Runs what is in a queue, until nothing is left or a signal requests the end.

    The caller is the sole runner. Args: say is called with one line for each start and end.
    Returns 0 if all runs are done, 1 if one has failed or was stopped, 130 after a signal.
    Raises QueueError or sqlite3.Error if the database cannot be used, OSError if there is no /proc.
    """
    with signals_blocked() as (signals, before):
        return _Runner(queue, limits, say, signals, before).run()


@dataclass
class _Live:
    entry: Entry
    child: subprocess.Popen[bytes] | None  # None: a runner before has started it


@dataclass
class _Runner:
    queue: Queue
    limits: Limits
    say: Callable[[str], None]
    signals: set[signal.Signals]  # that are blocked here
    before: set[Any]  # what is blocked in the runs
    live: dict[int, _Live] = field(default_factory=dict)
    resumed: list[Entry] = field(default_factory=list)  # to be resumed, before any that waits
    noted: Entry | None = None  # the one that waits for its share, as the database says
    stopping: bool = False
    failed: bool = False  # a run has

    def run(self) -> int:
        self._written(self.queue.forget_waits)  # of a runner before
        for entry in self._written(self.queue.running):
            self.live[entry.id] = _Live(entry, None)  # until it is seen that it is not
        while True:
            self._end_ended()
            if not self.stopping:
                self._start()
            idle = not self.live and not self.resumed and self._written(self.queue.next) is None
            if (self.stopping and not self.live) or (idle and not self.limits.forever):
                break
            self._take(_POLL_S)
        return _INTERRUPTED if self.stopping else int(self.failed)

    def _take(self, seconds: float) -> None:
        """Waits so long, or until a child ends, or a signal comes, which is passed on to the runs."""
        taken = signal.sigtimedwait(self.signals, seconds)
        if taken is None or taken.si_signo == signal.SIGCHLD:
            return
        if not self.stopping:
            self.say("stopping: the runs save checkpoints; the next `panolog queue run` resumes them first")
        self.stopping = True
        for live in self.live.values():
            if live.child is not None:
                live.child.send_signal(taken.si_signo)
            elif (process := live.entry.process) and processes.alive(process):
                with suppress(ProcessLookupError):
                    os.kill(process.pid, taken.si_signo)

    def _start(self) -> None:
        """Starts what there is room for: first what is to be resumed, then what waits, each in order."""
        while len(self.live) < self.limits.at_once:
            entry = self.resumed[0] if self.resumed else self._written(self.queue.next)
            if entry is None:
                return
            try:
                share = self._share(entry)
            except NeverFitsError as error:
                if claimed := self._claimed(entry):
                    self._end(claimed, State.FAILED, None, str(error))
                continue
            if isinstance(share, str):
                self._wait(entry, share)
                return
            if self.noted is not None:
                self._written(self.queue.forget_waits)
                self.noted = None
            if claimed := self._claimed(entry):
                self._launch(claimed, share)

    def _share(self, entry: Entry) -> Share | str | None:
        """What of the machine an entry gets now, or what it waits for; None for one on a cluster."""
        machine, at_once = self.limits.machine, self.limits.at_once
        held = [it.entry.share for it in self.live.values() if it.entry.share is not None]
        wanted = machine.wanted(entry, at_once)
        return None if wanted is None else machine.share(wanted, held, at_once)

    def _claimed(self, entry: Entry) -> Entry | None:
        """An entry that is to start or to fail, as running; None if it was moved away meanwhile."""
        if self.resumed and self.resumed[0] is entry:
            return self.resumed.pop(0)
        return self._written(lambda: self.queue.claim(entry.id))

    def _wait(self, entry: Entry, reason: str) -> None:
        if self.noted is not None and (self.noted.id, self.noted.reason) == (entry.id, reason):
            return
        if self.noted is not None and self.noted.id != entry.id:  # it was moved
            self._written(self.queue.forget_waits)
        self.noted = replace(entry, reason=reason)
        self._written(lambda: self.queue.note(entry.id, reason))
        self.say(f"{entry.id}: {reason}")

    def _launch(self, entry: Entry, share: Share | None) -> None:
        root = entry.command.run
        resumes = entry.interrupted and RunFolder(root).info.exists()
        words = ("resume", str(root), *entry.command.later) if resumes else ("run", *entry.command.first)
        command = [*_GATE, *self.limits.program, *words, "--supervise"]
        try:
            with self._log(entry) as log:
                child = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    cwd=entry.command.folder,
                    env={**os.environ, **environment(share, self.limits.machine)},
                    start_new_session=True,  # a terminal's Ctrl-C reaches it through the runner alone
                    preexec_fn=bound_to_parent(self.before),  # noqa: PLW1509  # there are no other threads
                )
        except OSError as error:
            self._end(entry, State.FAILED, None, f"it cannot be started: {error.filename}: {error.strerror}")
            return
        assert child.stdin is not None  # a pipe
        with suppress(ProcessLookupError, BrokenPipeError):  # it was killed at the gate
            identity = processes.identity(child.pid)
            if share is not None and share.cores is not None:
                os.sched_setaffinity(child.pid, share.cores)  # which all that it starts has too
            self._written(lambda: self.queue.launched(entry.id, identity, share))
            child.stdin.write(b"\n")
            child.stdin.flush()
        with suppress(BrokenPipeError):
            child.stdin.close()
        self.live[entry.id] = _Live(self._written(lambda: self.queue.entry(entry.id)), child)
        self.say(f"{'resumed' if resumes else 'started'} {entry.id}: {root}")

    def _log(self, entry: Entry) -> Any:
        path = log_of(self.queue.folder, entry.id)
        path.parent.mkdir(exist_ok=True)
        long = path.exists() and path.stat().st_size > _LOG
        return os.fdopen(
            os.open(path, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if long else os.O_APPEND), 0o600), "wb"
        )

    def _end_ended(self) -> None:
        for id, live in list(self.live.items()):
            code = live.child.poll() if live.child is not None else None
            ended = code is not None if live.child is not None else not processes.alive(live.entry.process)
            if not ended or lock.held(RunFolder(live.entry.command.run).lock):
                continue  # a supervisor that was killed leaves its driver time to save
            del self.live[id]
            self._judge(live.entry, code, of_runner=live.child is not None)

    def _judge(self, entry: Entry, code: int | None, *, of_runner: bool) -> None:
        """What follows from the end of a run. Args: code, None of one that was not a child."""
        state = state_of(entry.command.run)
        began = entry.began or 0.0
        known = state.ended is not None and state.ended >= began  # not the end of a driver before
        outcome = state.outcome if known else None
        if code == 0 or outcome == Outcome.DONE:
            self._end(entry, State.DONE, 0, "")
        elif code == _INTERRUPTED and not self.stopping:
            reason = f"stopped by a user; {_resume(entry)} resumes it"
            self._end(entry, State.STOPPED, code, reason)
        elif (code is not None and code > 0 and code != _INTERRUPTED) or (
            outcome == Outcome.FAILED and not state.transient
        ):
            reason = state.reason if known and state.reason else self._last_line(entry)
            self._end(entry, State.FAILED, code if code is not None else 1, reason)
        elif of_runner and not self.stopping:
            self._lost(entry, code)
        else:
            self._resume_later(entry)

    def _lost(self, entry: Entry, code: int | None) -> None:
        """Resumes an entry whose supervisor was killed, but not without end."""
        losses = self._written(lambda: self.queue.lose(entry.id))
        how = f"signal {-code}" if code is not None else "a signal"
        if losses >= _LOSSES:
            reason = f"its process was killed {losses} times in a row by {how}; {_resume(entry)} tries again"
            self._end(entry, State.FAILED, code, reason)
            return
        self.say(f"{entry.id}: its process was killed by {how}; it is resumed")
        self._resume_later(entry)

    def _resume_later(self, entry: Entry) -> None:
        self.resumed.append(self._written(lambda: self.queue.entry(entry.id)))
        self.resumed.sort(key=lambda one: (one.position, one.id))

    def _end(self, entry: Entry, state: State, code: int | None, reason: str) -> None:
        self._written(lambda: self.queue.end(entry.id, state, code, reason))
        self.failed = self.failed or state != State.DONE
        self.say(f"{state} {entry.id}: {entry.command.run}" + (f": {reason}" if reason else ""))

    def _last_line(self, entry: Entry) -> str:
        """The last line of a run's output, in which `panolog` says what is wrong."""
        path = log_of(self.queue.folder, entry.id)
        with suppress(OSError), path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _TAIL))
            if line := last_line(file.read(_TAIL).decode(errors="replace")):
                return line.removeprefix("panolog: ")
        return f"see {path}"

    def _written(self, work: Callable[[], _Answer]) -> _Answer:
        """The result of work on the database, which is tried again while its disk takes nothing."""
        said = False
        while True:
            try:
                return work()
            except sqlite3.OperationalError as error:
                if self.stopping:
                    raise  # the next runner finds out what has become of its runs
                if not said:
                    self.say(f"waiting for {self.queue.folder}: {error}; free its disk, or end what locks it")
                said = True
                self._take(_FULL_S)


def _resume(entry: Entry) -> str:
    return f"`{command_line('queue', 'retry', entry.id)}`"
