"""What is measured of a process."""

import subprocess
import sys

import pytest

from panolog.workers.meter import EARLY, PreviewClock
from panolog.workers.training.task_config import PreviewConfig

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


def test_previews_come_early_then_by_time_and_take_little_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    clock = PreviewClock(PreviewConfig(every=10**9, seconds=10))
    assert [iteration for iteration in range(1, 1_000) if clock.due(iteration)] == list(EARLY)
    assert PreviewClock(PreviewConfig(every=500)).due(1_500)

    def until_due(cost: float) -> float:
        """Seconds from one that took so long to the next."""
        with clock.timed():
            now[0] += cost
        began = now[0]
        while not clock.due(7):
            now[0] += 0.5
        return now[0] - began

    assert until_due(0.01) == 10
    assert until_due(0.5) == 50  # 1 % of the time
    now[0] = 86_400.0
    assert until_due(0.01) == pytest.approx(0.05 * 86_400, abs=1)  # of days there are no thousands
