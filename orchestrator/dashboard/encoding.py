"""JSON as browsers take it."""

import gzip
import json
import math
from typing import Any

from fastapi import Request
from fastapi.responses import Response

_SMALL = 1_000  # bytes that are not worth packing


def encode(content: Any) -> bytes:
    """ASCII JSON in one line; numbers that it does not have, which only a hostile run can hold, are null."""
    try:
        text = json.dumps(content, default=vars, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(content), default=vars, allow_nan=False, separators=(",", ":"))
    return text.encode()


def _finite(value: Any) -> Any:
    if hasattr(value, "__dict__"):
        value = vars(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def json_response(request: Request, data: bytes, status: int = 200) -> Response:
    """Encoded JSON as an answer, packed if the client takes that: phones are on slow networks."""
    headers = {"Cache-Control": "no-store", "Vary": "Accept-Encoding"}
    if len(data) > _SMALL and "gzip" in request.headers.get("accept-encoding", ""):
        data = gzip.compress(data, 3)
        headers["Content-Encoding"] = "gzip"
    return Response(data, status, headers, "application/json")
