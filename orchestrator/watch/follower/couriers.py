"""Delivers notifications to one target, in order and in its own thread: one that hangs delays no other.

Delivery is at least once. An id is noted as delivered after its target has taken it, so a kill between the
two sends it again, with the same id.
"""

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from panolog.orchestrator.watch.follower.board import Board, News
from panolog.orchestrator.watch.follower.ledger import Ledger
from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.sending import Refusal, send
from panolog.orchestrator.watch.follower.targets import Target

_TRIES = 60  # of one notification by one follower: hours, if the run lasts
_MOST = 100  # notifications of one run to one target, besides its end
_ENDS = (Kind.DONE, Kind.FAILED)
Send = Callable[[Target, Notification], Refusal | None]


class Courier(threading.Thread):
    """One target of a run."""

    def __init__(self, target: Target, board: Board, path: Path, deliver: Send = send) -> None:
        """Args: path, of its ledger; deliver, sends one notification once."""
        super().__init__(name=target.label, daemon=True)
        self.label = f"notify {target.label}"
        self.problem = ""  # why something was not delivered; one line
        self._target, self._board, self._path, self._deliver = target, board, path, deliver
        self._over: set[str] = set()  # ids that are delivered, or never will be

    def run(self) -> None:
        """Works until the run has ended and all is delivered, or no time is left."""
        news = self._board.news
        while not news.run:
            if news.ended:
                return
            news = self._board.wait(60.0, news)
        self._ledger = Ledger(self._path, news.run)
        if self._ledger.new:  # what was before is no news to this target
            self._note(since=news.began - 1)
        self._over = set(self._ledger.get("delivered", [])) | set(self._ledger.get("abandoned", {}))
        while True:
            due = self._due(news)
            if news.ended and (not due or self._board.left <= 0):
                return
            if not all(self._settle(notification) for notification in due):
                return
            news = self._board.wait(60.0, news) if not news.ended else self._board.news

    def _due(self, news: News) -> list[Notification]:
        since = self._ledger.get("since", 0)
        due = [it for it in news.notifications if it.record > since and it.id not in self._over]
        room = _MOST - len(self._over)
        ends = [it for it in due if it.kind in _ENDS]
        return [it for it in due if it.kind not in _ENDS][: max(0, room)] + ends

    def _settle(self, notification: Notification) -> bool:
        """Delivers one, or gives it up. Returns False if the time is up before that."""
        problem = ""
        for tried in range(_TRIES):
            refusal = self._deliver(self._target, notification)
            if refusal is None:
                self._over.add(notification.id)
                self._note(delivered=[*self._ledger.get("delivered", []), notification.id])
                return True
            problem = f"{refusal.reason}; not delivered: {notification.kind}"
            if refusal.final:
                break
            if not self._board.pause(tried, refusal.after):
                self.problem = problem
                return False
        self.problem = problem
        self._over.add(notification.id)
        self._note(abandoned=self._ledger.get("abandoned", {}) | {notification.id: self.problem})
        return True

    def _note(self, **values: object) -> None:
        """A full disk costs the memory of what was delivered, not the delivery."""
        with suppress(OSError):
            self._ledger.keep(**values)
