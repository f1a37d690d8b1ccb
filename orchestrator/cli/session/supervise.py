"""`panolog run --supervise`: resumes a run whose driver has died, with a limit.

The supervisor is a small process without torch and Ray, so that it does not die with them: Ray ends a driver
whose cluster has lost its head (the GCS) from C++, where no Python code runs any more. The driver is a child
of the supervisor. If that is killed, the kernel sends the driver SIGTERM, and it ends as after Ctrl-C: a run
never has a driver that the system which has started the supervisor does not know.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.folder import RunFolder, command_line
from panolog.orchestrator.runs.machines.children import bound_to_parent, signals_blocked
from panolog.orchestrator.runs.preparation.settings import Step
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.runs.state import RunState, Status
from panolog.orchestrator.runs.units import duration
from panolog.workers.tasks import TaskId

_PROGRAM = (sys.executable, "-m", "panolog.orchestrator.cli")
_POLL_S = 1.0  # between two looks at the driver, should its end not be reported, and at requests
_FIRST_S, _LONGEST_S = 2.0, 300.0  # pauses before a resume: twice as long after each without progress
_HEAD_S, _HEAD_POLL_S = 1800.0, 2.0  # that the head of a lost cluster gets to come back; between two looks
_CONNECT_S = 10.0  # in which a head must answer
_CODES = (0, 1, 2, 130)  # of panolog
# Steps of the preparation that are done; of each task whether it is, and the iteration of its checkpoint.
Saved = tuple[frozenset[Step], dict[TaskId, tuple[bool, int | None]]]


@dataclass(frozen=True)
class Supervised:
    """What is supervised, and how."""

    root: Path  # of the run
    first: Sequence[str]  # arguments of `panolog` for the first driver
    options: Sequence[str]  # of `panolog resume` for the others
    limits: Sequence[str]  # options that count once a driver has recorded them: of cost and time
    address: str | None  # of the cluster
    limit: int  # of resumes without progress
    say: Callable[[str], None]  # called with one line


def supervise(run: Supervised) -> int:
    """Runs drivers until one has ended for good.

    Returns its exit code; 1 if it was killed, 130 if that was wanted.
    """
    with signals_blocked() as (signals, before):
        return _Supervisor(run, signals, before).supervise()


def cause(code: int, state: RunState, *, own: bool) -> str | None:
    """Why another driver may succeed after one has ended; None if it would not, or is not wanted.

    Args: code, its exit code, or minus the signal that has killed it; state, of the run afterwards; own,
    whether that is this driver's, which has taken the run over.
    """
    if code < 0:
        return f"killed by signal {-code} ({signal.Signals(-code).name})"
    if code in (0, 130) or not own:
        return None  # as wanted, or before it has taken the run over
    if state.outcome is None:
        return f"exit code {code} without a record, as when Ray has lost the head of its cluster"
    return state.reason if state.outcome == Outcome.FAILED and state.transient else None


@dataclass
class _Supervisor:
    """A supervisor at work."""

    run: Supervised
    signals: set[signal.Signals]  # that are blocked here
    before: set[Any]  # what is blocked in the drivers
    stopping: bool = False  # a user has requested it
    taken: bool = False  # a driver of this supervisor has taken the run over, and recorded the limits

    def supervise(self) -> int:
        """Runs drivers until the run is over; returns what `supervise` returns."""
        run, arguments, tries, saved = self.run, self.run.first, 0, progress_made(self.run.root)
        while True:
            code, why = self._drive(arguments)
            if why is None or self.stopping:
                return code if code in _CODES else 130
            saved, earlier = progress_made(run.root), saved
            tries = tries + 1 if saved == earlier else 1
            end = f"the driver has ended ({why})"
            if tries > run.limit:
                run.say(f"{end}; {run.limit} resumes made no progress: {self._resume} tries again")
                return code if code in _CODES else 1
            pause = min(_FIRST_S * 2 ** (tries - 1), _LONGEST_S)
            run.say(f"{end}; resume {tries} of at most {run.limit} without progress in {pause:.0f} s")
            self._wait(pause)
            if not self._head_answers():
                return 1
            if self.stopping:
                run.say(f"stopped; {self._resume} resumes the run")
                return 130
            if RunFolder(run.root).info.exists():
                limits = () if self.taken else run.limits
                arguments = ["resume", str(run.root), *run.options, *limits, "--resumed-after", why]

    @property
    def _resume(self) -> str:
        return f"`{command_line('resume', self.run.root)}`"

    def _drive(self, arguments: Sequence[str]) -> tuple[int, str | None]:
        """Runs one driver to its end. Returns its exit code or minus its signal, and why another may help."""
        # preexec_fn is for programs without other threads: the one that keeps a mirror only waits for lines
        driver = subprocess.Popen([*_PROGRAM, *arguments], preexec_fn=bound_to_parent(self.before))  # noqa: PLW1509
        while (code := driver.poll()) is None:
            if (number := self._taken(_POLL_S)) is not None:
                driver.send_signal(number)
        state = control.state_of(self.run.root)
        own = state.driver is not None and state.driver.pid == driver.pid
        self.taken = self.taken or own
        if own and state.outcome == Outcome.DONE:
            return 0, None  # what has ended it came afterwards, such as the end of the cluster's head
        return code, cause(code, state, own=own)

    def _taken(self, seconds: float) -> int | None:
        """The next request to stop, if one comes in that time; also returns when a driver has ended."""
        taken = signal.sigtimedwait(self.signals, seconds)
        if taken is None or taken.si_signo == signal.SIGCHLD:
            return None
        self.stopping = True
        return taken.si_signo

    def _wait(self, seconds: float) -> None:
        """Waits so long, or until a request to stop: by a signal, or as `panolog stop` leaves one."""
        folder, end = RunFolder(self.run.root), time.monotonic() + seconds
        with lock.hold(folder.supervisor) if folder.control.is_dir() else nullcontext():
            while not self.stopping and (left := end - time.monotonic()) > 0:
                self._taken(min(left, _POLL_S))
                self.stopping = self.stopping or control.stop_requested(folder)

    def _head_answers(self) -> bool:
        """Waits for the head of the cluster, but not for ever. True if it answers, or need not."""
        address = os.environ.get("RAY_ADDRESS", "") if self.run.address == "auto" else self.run.address
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        if not port.isdecimal() or _answers(host, int(port)):
            return True
        self.run.say(f"waiting at most {duration(_HEAD_S)} for the cluster at {address}")
        end = time.monotonic() + _HEAD_S
        while not self.stopping and time.monotonic() < end:
            self._wait(_HEAD_POLL_S)
            if _answers(host, int(port)):
                return True
        if not self.stopping:
            self.run.say(f"the cluster at {address} does not answer: {self._resume} tries again")
        return self.stopping


def _answers(host: str, port: int) -> bool:
    with suppress(OSError, OverflowError), socket.create_connection((host, port), timeout=_CONNECT_S):
        return True
    return False


def progress_made(root: Path) -> Saved:
    """What a next driver of a run need not do again: if that grows, resuming it is worth it."""
    folder, state = RunFolder(root), control.state_of(root)
    steps = frozenset(step for step in Step if folder.step_result(step).exists())
    return steps, {task.id: (task.status == Status.DONE, task.checkpoint) for task in state.tasks.values()}
