"""One step in a process group of its own: its limit, its log and what it left.

Imports neither torch nor the package's compiled module: what breaks these must not break the page.
"""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.first_hour.outcome import ROOT, Context, Outcome, python, result_file

MODULE = "benchmarks.first_hour.step"
TICK_S = 10.0  # between two lines of progress
GRACE_S = 10.0  # for a process to end after a signal
_REASON = 300  # characters of a reason


@dataclass(frozen=True)
class Ran:
    """A step that has run."""

    outcome: Outcome
    seconds: float


def run(
    context: Context, tick: Callable[[float, str], None], clock: Callable[[], float] = time.monotonic
) -> Ran:
    """Runs a step in a new folder until it ends or its limit is over; a KeyboardInterrupt ends it too.

    Args: tick, called now and then with the seconds so far and the last line of the log; clock, in seconds.
    """
    shutil.rmtree(context.work, ignore_errors=True)
    context.work.mkdir()
    log = log_file(context)
    command = python("-m", MODULE, json.dumps(asdict(context)))
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    began = clock()
    with log.open("wb") as out:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = _wait(
                process, began + context.seconds, clock, lambda: tick(clock() - began, last_line(log))
            )
        finally:
            _end(process)
    return Ran(_outcome(context, code, log), clock() - began)


def log_file(context: Context) -> Path:
    """What the step and its commands print."""
    return context.work / "log.txt"


def last_line(log: Path) -> str:
    """The last line of a log that has something on it."""
    lines = log.read_bytes()[-4096:].decode(errors="replace").replace("\r", "\n").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _wait(
    process: subprocess.Popen[bytes], end: float, clock: Callable[[], float], tick: Callable[[], None]
) -> int | None:
    """The exit code of a process, or None if it still runs at the end."""
    while (left := end - clock()) > 0:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(min(TICK_S, left))
        tick()
    return process.poll()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ends the group of a process. One that the kernel holds, for a card that hangs, is left behind."""
    with suppress(ProcessLookupError):
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                process.wait(GRACE_S)
        os.killpg(process.pid, signal.SIGKILL)
    with suppress(subprocess.TimeoutExpired):
        process.wait(GRACE_S)


def _outcome(context: Context, code: int | None, log: Path) -> Outcome:
    """What the step has left, and why it failed if it did. Args: code, its exit code; None: stopped."""
    file = result_file(context.folder, context.step)
    left = Outcome(**json.loads(file.read_bytes())) if file.exists() else Outcome("failed")
    if code == 0 and file.exists():
        return left
    if code is None:
        why = f"stopped after its limit of {context.seconds:.0f} s"
    elif code < 0:
        why = f"ended by {signal.Signals(-code).name}"
    elif code == 0:
        why = "it left no result"
    else:
        why = last_line(log) or f"ended with exit code {code}"
    return Outcome(**{**asdict(left), "ending": "failed", "reason": why[:_REASON]})
