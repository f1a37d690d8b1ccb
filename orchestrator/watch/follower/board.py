"""What the follower knows of the run, for the threads that pass it on."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

from panolog.orchestrator.runs.clock import CLOCK, Clock
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.watch.follower.notifications import Notification

_FIRST_S, _LONGEST_S = 2.0, 300.0  # pauses between tries, each twice as long as the one before
_LAST_S = 5.0  # the longest pause between tries once the run has ended
ALL = 2**62  # an iteration beyond every one: all curves of the task are settled


@dataclass(frozen=True)
class News:
    """The run as it is now."""

    run: str = ""  # `notifications.run_id`; "" before there is a run that is worth following
    began: int = 0  # Stored.id of the latest RunBegan
    notifications: tuple[Notification, ...] = ()  # all, in order
    settled: Mapping[str, int] = field(default_factory=dict)  # task -> iteration up to which curves stay
    ended: bool = False  # nothing more will come
    outcome: Outcome | None = None  # once it has ended; None if its driver was killed
    metrics: Mapping[str, float | None] = field(default_factory=dict)  # of the merged model, once it is done


class Board:
    """Holds the news; any thread waits for newer ones."""

    def __init__(self, clock: Clock = CLOCK) -> None:
        self._changed = threading.Condition()
        self._clock = clock
        self._news = News()
        self._end = 0.0  # clock.monotonic() at which every thread has to end

    def publish(self, news: News, seconds: float = 0.0) -> None:
        """Replaces the news. Args: seconds, if the run has ended: for which threads may still work."""
        with self._changed:
            self._news = news
            self._end = self._clock.monotonic() + seconds
            self._changed.notify_all()

    @property
    def news(self) -> News:
        """The latest."""
        return self._news

    def wait(self, seconds: float, known: News) -> News:
        """The latest news, as soon as they are others than the known ones, or after so many seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._news is not known, seconds)
            return self._news

    def pause(self, tries: int, least: float = 0.0) -> bool:
        """Waits between two tries: until the run has ended, or longer each time; then for a short time.

        Args: tries, before the one that failed; least, seconds. Returns whether there is time for another.
        """
        seconds = max(least, min(_FIRST_S * 2**tries, _LONGEST_S))
        if self._news.ended:
            self._clock.sleep(max(0.0, min(seconds, _LAST_S, self.left)))
            return self.left > 0
        with self._changed:
            self._changed.wait_for(lambda: self._news.ended, seconds)
        return True

    @property
    def left(self) -> float:
        """Seconds that are left to work, once the run has ended."""
        return self._end - self._clock.monotonic()
