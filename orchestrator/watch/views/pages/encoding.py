"""JSON as browsers take it."""

import base64
import json
import math
from typing import Any

import numpy as np
from pydantic import BaseModel


def encode(content: Any) -> bytes:
    """ASCII JSON in one line. Not a number and infinity, which only a damaged run can hold, become null."""
    try:
        text = json.dumps(content, default=_plain, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(content), allow_nan=False, separators=(",", ":"))
    return text.encode()


def _plain(value: Any) -> Any:
    """A value as JSON has it: an array in base64, a fraction of the size of its digits."""
    if isinstance(value, np.ndarray):
        data, kind = base64.b64encode(value.tobytes()).decode(), value.dtype.str.lstrip("<|")
        return {"dtype": kind, "bdata": data, "shape": ", ".join(map(str, value.shape))}
    return value.model_dump(mode="python") if isinstance(value, BaseModel) else vars(value)


def _finite(value: Any) -> Any:
    if isinstance(value, str | int | None):  # enums, too
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray) or hasattr(value, "__dict__"):
        value = _plain(value)
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
