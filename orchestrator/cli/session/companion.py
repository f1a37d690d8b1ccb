"""Processes next to a driver: the dashboard (`--dashboard`) and the follower (`--notify`, `--log`)."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, PIPE
from threading import Thread

from panolog.orchestrator.runs.machines.children import send_line, start_companion
from panolog.orchestrator.watch.follower.recipients import END, LAST_S, Recipients, to_json

_TIMEOUT_S = 8.0  # for the process to send its pages the last state of the run, and to end
_FOLLOWER_S = LAST_S + 5.0  # for the follower to end
_LINES = 20  # of what it could not do


@contextmanager
def companion_dashboard(run: Path, say: Callable[[str], None]) -> Iterator[Thread | None]:
    """Serves the dashboard of a run while the context lasts. Its failure does not affect the run.

    Args: say, called with the URL once it is known, or with why there is no dashboard.
    Yields the thread that waits for the URL.
    """
    command = [sys.executable, "-m", "panolog.orchestrator.watch.dashboard", str(run.absolute())]
    try:
        # In a session of its own, so that Ctrl-C reaches the driver alone: the page shows how the run ends.
        process = subprocess.Popen(
            command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL, text=True, start_new_session=True
        )
    except OSError as error:
        say(f"no dashboard: {error.strerror}")
        yield None
        return

    def announce() -> None:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        say(f"dashboard {url}" if url else "no dashboard: its process has ended")

    announcer = Thread(target=announce, daemon=True)
    announcer.start()
    try:
        yield announcer
    finally:
        process.terminate()
        try:
            process.wait(_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def companion_follower(run: Path, recipients: Recipients, say: Callable[[str], None]) -> Iterator[None]:
    """Follows a run while the context lasts, and then until the last news are delivered, for a bounded time.

    Its failure does not affect the run. If it was killed, another one delivers what is left at the end.
    Args: say, called with a line for each thing that could not be done.
    """
    if not recipients:
        yield
        return
    start = partial(start_companion, "panolog.orchestrator.watch.follower", to_json(recipients, run))
    process = start()
    try:
        yield
    finally:
        said, killed = _end(process)
        if killed:
            process = start()
            said, _ = _end(process)
        for line in said.splitlines()[:_LINES]:
            say(line)
        if process.returncode:
            say(f"the follower has ended early (code {process.returncode}): not all may be delivered")


def _end(process: "subprocess.Popen[str]") -> tuple[str, bool]:
    """Lets a follower deliver the last news. Returns its lines, and whether something else ended it before.

    Its exit code is the only proof: before a killed process can be reaped, it still counts as running.
    """
    try:
        send_line(process, END)
        said, _ = process.communicate(timeout=_FOLLOWER_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()[0], False
    return said, process.returncode != 0
