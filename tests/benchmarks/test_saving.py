"""The benchmark of checkpoints: the bound of memory on a small load."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system


def test_no_more_messages_are_in_memory_than_writers(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.saving", "--quick", "--json", "--folder", str(tmp_path)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    report = json.loads(ended.stdout)  # the exit code depends on the disk
    assert [(one["writers"], one["most"] <= one["writers"]) for one in report["measured"]] == [
        (1, True),
        (2, True),
        (4, True),
    ]
