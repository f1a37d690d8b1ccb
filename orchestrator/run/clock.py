"""Time as the driver sees it, so that a simulation can have its own."""

import time
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
