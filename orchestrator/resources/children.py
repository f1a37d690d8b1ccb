"""Child processes of a supervisor: they end with it, and signals reach them through it."""

import ctypes
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # are passed on to children
_PR_SET_PDEATHSIG = 1  # of prctl(2)
_LIBC = ctypes.CDLL(None)


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
