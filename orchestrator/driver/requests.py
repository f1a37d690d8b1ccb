"""What users request of a driver through the run folder."""

from contextlib import suppress

from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.driver.stopping import Stop
from panolog.orchestrator.run import control
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed


class Requests:
    """Those that were taken from the folder and are not yet carried out."""

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
