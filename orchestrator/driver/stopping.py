"""Ctrl-C: the first requests a run to stop with fresh checkpoints, the second stops it at once.

A driver must not be interrupted in the middle of a record, so the first signal only sets a flag; it does
interrupt work that takes long and can be discarded (`at_once`). SIGTERM, as job systems send it, is the same.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ENDS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Whether the run is requested to stop."""

    def __init__(self) -> None:
        self.requested = False
        self._at_once = False

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Inside, the first signal raises KeyboardInterrupt too. So does entering after it."""
        if self.requested:
            raise KeyboardInterrupt
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def signal(self, _number: int = 0, _frame: FrameType | None = None) -> None:
        """One signal. Raises KeyboardInterrupt if it is to stop at once."""
        again, self.requested = self.requested, True
        if again or self._at_once:
            raise KeyboardInterrupt


@contextmanager
def on_signals() -> Iterator[Stop]:
    """A `Stop` that handles Ctrl-C and SIGTERM while the context lasts; for the main thread.

    A signal that is ignored, as Ctrl-C is by a shell's background jobs, stays so.
    """
    stop = Stop()
    handled = [number for number in _ENDS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, stop.signal) for number in handled}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
