"""Time as the driver sees it, so that a simulation can have its own."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Protocol


class Clock(Protocol):
    """The module `time`, or what takes its place."""

    def time(self) -> float:
        """Seconds since the epoch, for records."""

    def monotonic(self) -> float:
        """Seconds that never jump, for durations."""

    def sleep(self, seconds: float) -> None:
        """Waits where nothing reports an end."""


CLOCK: Clock = time
_JUMP_S = 60.0  # by which the clock of the machine may be adjusted


class Steady:
    """The time of one driver: that of its machine, as long as it does not jump.

    From then on it is the time of the begin and the seconds since, so that neither a clock that is set nor a
    machine that sleeps makes a run reach a limit. The next driver begins with the machine's clock again.
    """

    def __init__(self, clock: Clock = CLOCK) -> None:
        self._clock = clock
        self._began = clock.time() - clock.monotonic()

    def time(self) -> float:
        steady, now = self._began + self._clock.monotonic(), self._clock.time()
        return now if abs(now - steady) < _JUMP_S else steady

    def monotonic(self) -> float:
        return self._clock.monotonic()

    def sleep(self, seconds: float) -> None:
        self._clock.sleep(seconds)


@contextmanager
def repeated(call: Callable[[], None], seconds: float) -> Iterator[None]:
    """Calls something in a thread every so many seconds, while the context lasts."""
    ended = Event()

    def repeat() -> None:
        while not ended.wait(seconds):
            call()

    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
