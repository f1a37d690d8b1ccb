"""HTTP for clients that may be slow on purpose."""

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

_PATIENCE = 15.0  # seconds in which something must become a request


class Impatient(H11Protocol):
    """Ends connections that begin a request and do not finish it; uvicorn waits for ever."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begins to look at it now and then."""
        super().connection_made(transport)
        self._last: Any = self
        self._timer = self.loop.call_later(_PATIENCE, self._check)

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _check(self) -> None:
        """No request since the last look, and none being answered: it will not come."""
        idle = self.cycle is None or self.cycle.response_complete
        if idle and self._last is self.cycle:
            self.transport.close()
            return
        self._last = self.cycle
        self._timer = self.loop.call_later(_PATIENCE, self._check)
