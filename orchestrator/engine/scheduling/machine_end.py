"""A thread that looks for this machine's end before it comes."""

import logging
import math
import time
from collections.abc import Callable
from threading import Condition, Thread

from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.metadata import NoAnswerError, Provider, detect
from panolog.orchestrator.runs.records import Leaving

_LOOK_S = 2.0  # between two looks; the shortest notice of a provider is of 30 seconds
_RETRY_S = 30.0  # the same until the service answers for the first time
_SURVIVED_S = 300.0  # after its end from which on a machine whose notice is gone is there after all
_LOG = logging.getLogger(__name__)


class Watch:
    """What this machine knows of its end. Where no provider is detected, the thread ends at once."""

    def __init__(self, detect: Callable[[], Provider | None] = detect, look_s: float = _LOOK_S) -> None:
        """Args: detect, finds the provider, in the thread; look_s, seconds between two looks."""
        self._look_s = look_s
        self._detect = detect
        self._change = Condition()
        self._notice: LeaveNotice | None = None
        self._noted = -math.inf  # time.monotonic() of `_notice`
        self._answered = False  # the service, once
        self._closed = False
        Thread(target=self._run, name="leave notices", daemon=True).start()

    def notice(self) -> LeaveNotice | None:
        """The notice in force, with the seconds that are left now."""
        with self._change:
            return self._now()

    def wait(self, seen: Leaving | None, seconds: float) -> LeaveNotice | None:
        """The notice in force, once its kind is not the one that was seen; after so many seconds anyway."""
        with self._change:
            self._change.wait_for(lambda: self._kind != seen or self._closed, seconds)
            return self._now()

    def close(self) -> None:
        with self._change:
            self._closed = True
            self._change.notify_all()

    @property
    def _kind(self) -> Leaving | None:
        return self._notice.kind if self._notice else None

    @property
    def _survived(self) -> bool:
        """Whether the machine works long after its announced end, as after a hibernation."""
        if self._notice is None or self._notice.seconds is None:
            return False
        return time.monotonic() - self._noted > self._notice.seconds + _SURVIVED_S

    def _now(self) -> LeaveNotice | None:
        return self._notice and self._notice.after(time.monotonic() - self._noted)

    def _run(self) -> None:
        try:
            provider = self._detect()
        except ValueError as error:
            _LOG.warning("%s", error)
            return
        _LOG.debug("leave notices: %s", type(provider).__name__ if provider else "no provider")
        while provider is not None and not self._closed:
            pause = self._look(provider)
            with self._change:
                self._change.wait_for(lambda: self._closed, pause)

    def _look(self, provider: Provider) -> float:
        """Looks once; a service that does not answer changes nothing. Returns seconds until the next time."""
        try:
            found = provider.notice()
        except NoAnswerError as error:
            _LOG.debug("leave notices: %s", error)
            return self._look_s if self._answered else _RETRY_S
        self._answered = True
        with self._change:
            holds = self._kind is not None and self._kind not in provider.withdraws and not self._survived
            if found is None and holds:
                return self._look_s
            if found is None or self._notice is None or found.kind != self._notice.kind:
                self._notice, self._noted = found, time.monotonic()
                self._change.notify_all()
        return self._look_s
