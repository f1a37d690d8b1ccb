"""What a worker would say of a calibration, made up."""

from collections.abc import Iterator
from typing import Any

from panolog.workers.events import Calibrated, Event, Sample

MEBI = 2**20


def calibrated(**changes: Any) -> Calibrated:
    """400 MiB for everything but Gaussians; 10 ms and 1 µs for each Gaussian an iteration; two threads."""
    values: dict[str, Any] = {
        "task": "calibrate",
        "width": 64,
        "threads": 2,
        "images": MEBI,
        "begin": 0.5,
        "decode": 0.01,
        "share": 0.2,
        "initial": Sample(1_000, 0.011, 401 * MEBI, 0),
        "grown": Sample(11_000, 0.021, 420 * MEBI, 0),
        "single": 0.036,
        "look": 0.05,
    }
    return Calibrated(**values | changes)


def says(name: str, fields: dict[str, Any]) -> Iterator[Event]:
    """A script for a fake pool."""
    yield calibrated()
