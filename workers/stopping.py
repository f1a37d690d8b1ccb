"""How a worker process is requested to stop: a signal that sets a flag, which training polls.

SIGUSR1: Ray uses it for nothing, and a terminal's Ctrl-C does not send it.
"""

import os
import signal
from contextlib import suppress
from types import FrameType

_SIGNAL = signal.SIGUSR1


class _Process:
    """State of this process."""

    stop = False


def listen() -> None:
    """Resets the flag and installs the handler: in a worker's main thread, before each task."""
    _Process.stop = False
    signal.signal(_SIGNAL, _set)


def _set(_number: int, _frame: FrameType | None) -> None:
    _Process.stop = True


def requested() -> bool:
    """Whether this process was requested to stop since `listen`."""
    return _Process.stop


def request(pid: int) -> None:
    """Requests a worker process on this machine to stop; does nothing if it has ended."""
    with suppress(ProcessLookupError):
        os.kill(pid, _SIGNAL)
