"""Data that some tests need: it is next to the checkout, and not on every machine."""

from pathlib import Path

import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name: str) -> Path:
    """The folder ../shared/data/NAME next to the checkout; skips the test where it is missing."""
    path = _SHARED / name
    if not path.is_dir():
        pytest.skip(f"the test data {path} is not on this machine")
    return path
