"""Files of a run as answers: opened once, checked (`places.open_below`), sent as what they should be."""

import os
import re

from fastapi.responses import FileResponse
from starlette.types import Receive, Scope, Send

from panolog.orchestrator.dashboard.places import Place, by_handle, open_below

# A report may come from a run that somebody has sent: its scripts must not reach the dashboard.
_SANDBOX = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval';"
    " style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'none'"
)


class Download(FileResponse):
    """A file that stays the one that was opened."""

    def __init__(self, handle: int, media_type: str, headers: dict[str, str], name: str | None) -> None:
        """`name`: under which it is saved; None to look at it."""
        self._handle = handle
        super().__init__(
            by_handle(handle), 200, headers, media_type, filename=name, stat_result=os.fstat(handle)
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends it, or the part that was asked for."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            os.close(self._handle)

    @classmethod
    def of_model(cls, place: Place) -> "Download":
        """The merged model. Raises InputError if there is none."""
        handle = open_below(place.folder.point_cloud, place.folder.root)
        return cls(handle, "application/octet-stream", {"Cache-Control": "no-store"}, f"{_plain(place)}.ply")

    @classmethod
    def of_report(cls, place: Place, save: bool) -> "Download":
        """The report. Raises InputError if there is none."""
        handle = open_below(place.folder.report, place.folder.root)
        headers = {"Cache-Control": "no-store", "Content-Security-Policy": _SANDBOX}
        return cls(handle, "text/html; charset=utf-8", headers, f"{_plain(place)}.html" if save else None)


def _plain(place: Place) -> str:
    """A run's name as every file system takes it."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", place.folder.root.name).lstrip(".") or "run"
