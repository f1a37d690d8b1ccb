"""What is measured of a process."""

import subprocess
import sys

import pytest

from panolog.workers.meter import Meter
from panolog.workers.tasks import COARSE

HELD = 2**30  # bytes
CHILD = "from panolog.workers.meter import host_peak; print(host_peak())"
PARENT = f"""
import subprocess, sys
held = b"x" * {HELD}
print(subprocess.run([sys.executable, "-c", {CHILD!r}], check=True, capture_output=True, text=True).stdout)
"""


def test_the_peak_of_a_process_is_not_that_of_its_parent() -> None:
    """A worker of a process that has just made a scene is not as large as that was."""
    command = [sys.executable, "-c", PARENT]
    shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert 0 < int(shown) < HELD


def test_a_view_that_is_masked_altogether_does_not_count() -> None:
    meter = Meter(COARSE, 2, "cpu")
    assert meter.progress(0, 9).psnr is None
    for loss, mse in ((0.0, 0.0), (0.3, 0.01)):
        meter.count(loss, mse)
    report = meter.progress(2, 9)
    assert report.loss == 0.3
    assert report.psnr == pytest.approx(20)
