"""Answers: JSON as browsers take it, and files of a run as downloads."""

import gzip
import os
import re

from fastapi import Request
from fastapi.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from panolog.orchestrator.runs.folder import by_handle, open_below
from panolog.orchestrator.watch.dashboard.discovery import RunEntry

_UNCOMPRESSED = 1_000  # bytes up to which compression is not worth its time
# A report may come from another person's run: its scripts must not reach the dashboard.
_SANDBOX = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline' data:;"
    " style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'none'"
)


def json_response(request: Request, data: bytes, status: int = 200) -> Response:
    """Encoded JSON as an answer, compressed if the client accepts that: phones are on slow networks."""
    headers = {"Cache-Control": "no-store", "Vary": "Accept-Encoding"}
    if len(data) > _UNCOMPRESSED and "gzip" in request.headers.get("accept-encoding", ""):
        data = gzip.compress(data, 3)
        headers["Content-Encoding"] = "gzip"
    return Response(data, status, headers, "application/json")


class Download(FileResponse):
    """A file of a run, opened once and checked (`open_below`): what is sent is what was opened."""

    def __init__(self, handle: int, media_type: str, headers: dict[str, str], name: str | None) -> None:
        """`name`: the file name to save it as; None to show it in the browser."""
        self._handle = handle
        headers = {"Cache-Control": "no-store"} | headers
        super().__init__(
            by_handle(handle), 200, headers, media_type, filename=name, stat_result=os.fstat(handle)
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the file, or the range of it that was requested."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            os.close(self._handle)


def model_download(entry: RunEntry) -> Download:
    """The merged model. Raises InputError if there is none."""
    handle = open_below(entry.folder.point_cloud, entry.folder.root)
    return Download(handle, "application/octet-stream", {}, f"{file_name(entry)}.ply")


def page_download(entry: RunEntry) -> Download:
    """The model in 3D, as a page to show. Raises InputError if there is none."""
    handle = open_below(entry.folder.page, entry.folder.root)
    policy = f"{_SANDBOX}; connect-src data: blob:; worker-src blob:"
    return Download(handle, "text/html; charset=utf-8", {"Content-Security-Policy": policy}, None)


def report_download(entry: RunEntry, save: bool) -> Download:
    """The report, to save or to show. Raises InputError if there is none."""
    handle = open_below(entry.folder.report, entry.folder.root)
    name = f"{file_name(entry)}.html" if save else None
    return Download(handle, "text/html; charset=utf-8", {"Content-Security-Policy": _SANDBOX}, name)


def file_name(entry: RunEntry) -> str:
    """A run's name in characters that every file system accepts."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", entry.folder.root.name).lstrip(".") or "run"
