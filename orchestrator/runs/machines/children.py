"""Child processes: of a supervisor, which end with it and get signals through it, and next to a driver."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from subprocess import PIPE, Popen
from tempfile import TemporaryFile
from typing import Any

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # are passed on to children
_PR_SET_PDEATHSIG = 1  # of prctl(2)
_COMPLAINT = 4096  # bytes of stderr that are looked at
_LIBC = ctypes.CDLL(None)


class Companion(Popen[str]):
    """A process of a module of ours next to a driver, which gets a line with its plan through a pipe.

    The plan may have secrets: no other process can read a pipe. The process is in a session of its own, so
    that Ctrl-C does not reach it.
    """

    def __init__(self, command: Sequence[str], plan: str) -> None:
        self._errors = TemporaryFile()  # noqa: SIM115  # closed with this object
        super().__init__(
            command, stdin=PIPE, stdout=PIPE, stderr=self._errors, text=True, start_new_session=True
        )
        send_line(self, plan)

    @property
    def complaint(self) -> str:
        """The last line that it has written to stderr, such as the error of a traceback; "" without one."""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _COMPLAINT))
        return self._errors.read().decode(errors="replace").strip().rpartition("\n")[2]


def start_companion(module: str, plan: str) -> Companion:
    """A `Companion` of a module."""
    return Companion([sys.executable, "-m", module], plan)


def send_line(process: "Popen[str]", line: str) -> None:
    """Writes a line to a companion; one that was killed meanwhile does not get it."""
    assert process.stdin is not None
    with suppress(BrokenPipeError):
        process.stdin.write(line + "\n")
        process.stdin.flush()


@contextmanager
def signals_blocked() -> Iterator[tuple[set[signal.Signals], set[Any]]]:
    """Signals wait until they are taken, while the context lasts. Yields them, and the mask before.

    A signal that is ignored, as Ctrl-C is by a shell's background jobs, stays so.
    """
    child = signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # were it ignored, ends of children were lost
    signals = {number for number in ENDS if signal.getsignal(number) != signal.SIG_IGN} | {signal.SIGCHLD}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield signals, before
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        signal.signal(signal.SIGCHLD, child)


def bound_to_parent(mask: set[Any]) -> Callable[[], None]:
    """What a child of this process does before its program begins (`preexec_fn`).

    It gets SIGTERM from the kernel when this process ends, however that comes. Args: mask, its signal mask.
    """
    parent = os.getpid()

    def prepare() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it was killed before
            os.kill(os.getpid(), signal.SIGTERM)

    return prepare
