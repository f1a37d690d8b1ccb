"""Numbers for people, and from them."""

import pytest

from panolog.orchestrator.runs.units import gib, seconds_of


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("8w", 4_838_400),
        ("30d", 2_592_000),
        ("1d2h3m4s", 93_784),
        (" 1d  2h ", 93_600),
        ("1 h 30 m", 5400),
        ("1.5h", 5400),
        ("0s", 0),
    ],
)
def test_durations(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize(
    "text", ["", "h", "6", "-1h", "1y", "1,5h", ".5h", "1h tomorrow", "1" * 10 + "h", "1e3s"]
)
def test_what_is_none(text: str) -> None:
    assert seconds_of(text) is None


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0 MiB"), (7500, "7.3 KiB"), (2**20, "1 MiB"), (50 * 2**20, "50 MiB"), (2**30, "1.0 GiB")],
)
def test_sizes(size: int, text: str) -> None:
    assert gib(size) == text
