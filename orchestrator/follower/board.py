"""What the follower knows of the run, for the threads that pass it on."""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from panolog.orchestrator.follower.notifications import Notification
from panolog.orchestrator.run.records import Outcome

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

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._news = News()
        self._end = 0.0  # time.monotonic() at which every thread has to end

    def publish(self, news: News, seconds: float = 0.0) -> None:
        """Replaces the news. Args: seconds, if the run has ended: for which threads may still work."""
        with self._changed:
            self._news = news
            self._end = time.monotonic() + seconds
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

    def wait_for_end(self, seconds: float) -> None:
        """Waits until the run has ended, or for so many seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._news.ended, seconds)

    @property
    def left(self) -> float:
        """Seconds that are left to work, once the run has ended."""
        return self._end - time.monotonic()
