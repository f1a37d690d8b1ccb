"""Answers: JSON as browsers take it, and files of a run as downloads."""

import gzip
import json
import math
import os
import re
from typing import Any

from fastapi import Request
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel
from starlette.types import Receive, Scope, Send

from panolog.orchestrator.dashboard.discovery import RunEntry, by_handle, open_below

_UNCOMPRESSED = 1_000  # bytes up to which compression is not worth its time
# A report may come from another person's run: its scripts must not reach the dashboard.
_SANDBOX = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval';"
    " style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'none'"
)


def encode(content: Any) -> bytes:
    """ASCII JSON in one line. Not a number and infinity, which only a damaged run can hold, become null."""
    try:
        text = json.dumps(content, default=_plain, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(content), allow_nan=False, separators=(",", ":"))
    return text.encode()


def _plain(value: Any) -> Any:
    return value.model_dump(mode="python") if isinstance(value, BaseModel) else vars(value)


def _finite(value: Any) -> Any:
    if isinstance(value, str | int | None):  # enums, too
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "__dict__"):
        value = _plain(value)
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


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
    return Download(handle, "application/octet-stream", {}, f"{_file_name(entry)}.ply")


def report_download(entry: RunEntry, save: bool) -> Download:
    """The report, to save or to show. Raises InputError if there is none."""
    handle = open_below(entry.folder.report, entry.folder.root)
    name = f"{_file_name(entry)}.html" if save else None
    return Download(handle, "text/html; charset=utf-8", {"Content-Security-Policy": _SANDBOX}, name)


def _file_name(entry: RunEntry) -> str:
    """A run's name in characters that every file system accepts."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", entry.folder.root.name).lstrip(".") or "run"
