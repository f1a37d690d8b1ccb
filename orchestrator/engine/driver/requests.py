"""What users request of a driver, by signals and through the run folder.

A driver must not be interrupted in the middle of a record, so the first Ctrl-C, SIGTERM or SIGHUP only sets a
flag, and the run stops with fresh checkpoints; it does interrupt work that takes long and can be discarded
(`at_once`). The second stops the run at once.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TypeVar

from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.runs import control
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Noticed

_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
T = TypeVar("T")
_ONE_S = 1.0  # signals within it are one request: a terminal or job system and a supervisor may both send it


class Stop:
    """Whether the run is requested to stop."""

    def __init__(self) -> None:
        self.requested = False
        self._at_once = False
        self._latest = -math.inf  # time.monotonic() of the last request

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
        now = time.monotonic()
        if now - self._latest < _ONE_S:
            return
        self._latest = now
        again, self.requested = self.requested, True
        if again or self._at_once:
            raise KeyboardInterrupt


@contextmanager
def on_signals() -> Iterator[Stop]:
    """A `Stop` that handles those signals while the context lasts; for the main thread.

    A signal that is ignored, as Ctrl-C is by a shell's background jobs and SIGHUP by nohup, stays so. A
    request of an outer context counts: its KeyboardInterrupt is lost if it comes in a destructor.
    """
    stop = Stop()
    handled = [number for number in _ENDS if signal.getsignal(number) != signal.SIG_IGN]
    outer = [getattr(signal.getsignal(number), "__self__", None) for number in handled]
    stop.requested = any(isinstance(it, Stop) and it.requested for it in outer)
    before = {number: signal.signal(number, stop.signal) for number in handled}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt() -> None:
    """Sends the main thread one of those signals that it handles: for another thread of the process."""
    handled = [number for number in _ENDS if signal.getsignal(number) not in (signal.SIG_IGN, signal.SIG_DFL)]
    if handled and (ident := threading.main_thread().ident) is not None:
        signal.pthread_kill(ident, handled[0])


@contextmanager
def interruptible() -> Iterator[None]:
    """Each of those signals raises KeyboardInterrupt while the context lasts, once for each request."""
    with on_signals() as stop, stop.at_once():
        yield


def uninterrupted(work: Callable[..., T], *arguments: object) -> T:
    """Calls a function in a thread, where no signal interrupts it; the caller is interrupted when it is over.

    An import of torch that has ended halfway crashes the process at the next one.
    """
    with ThreadPoolExecutor(1, "uninterrupted") as thread:
        return thread.submit(work, *arguments).result()


class Requests:
    """The requests that were taken from the folder and are not yet carried out."""

    def __init__(self, folder: RunFolder, journal: Journal, stop: Stop) -> None:
        self._folder = folder
        self._journal = journal
        self._stop = stop
        self._waiting: list[control.ControlRequest | Noticed] = []

    def poll(self) -> None:
        """While the disk takes nothing: only a request to stop is carried out, at once."""
        with suppress(OSError):
            self._waiting += control.take(self._folder)
        if control.ControlRequest(control.Action.STOP) in self._waiting:
            self._stop.requested = True
        if self._stop.requested:
            raise KeyboardInterrupt

    def carry_out(self) -> bool:
        """Records what they change. Returns whether another task may start now."""
        self._waiting += self._journal.until_done(lambda: control.take(self._folder))
        news = False
        while self._waiting:
            request = self._waiting.pop(0)
            if isinstance(request, Noticed):
                self._journal.record([request])
            elif request.action == control.Action.STOP:
                self._stop.requested = True
            else:
                self._journal.record(control.answer(self._journal.state, request))
                news = True
        return news
