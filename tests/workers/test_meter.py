"""What is measured of a process."""

import subprocess
import sys

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
