"""`panolog run --dashboard`: the dashboard of one run as a process next to the driver."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL, PIPE
from threading import Thread

_TIMEOUT_S = 8.0  # for the process to send its pages the last state of the run, and to end


@contextmanager
def companion_dashboard(run: Path, say: Callable[[str], None]) -> Iterator[Thread | None]:
    """Serves the dashboard of a run while the context lasts. Its failure does not affect the run.

    Args: say, called with the URL once it is known, or with why there is no dashboard.
    Yields the thread that waits for the URL.
    """
    command = [sys.executable, "-m", "panolog.orchestrator.dashboard", str(run.absolute())]
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
