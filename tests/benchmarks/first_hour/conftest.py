"""Steps whose process runs the code of a test."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.first_hour import supervise


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes the process of each step run this code instead."""

    def make(code: str) -> None:
        lines = [
            "import json, os, signal, subprocess, sys",
            "from pathlib import Path",
            "from benchmarks.first_hour import step",
            "from benchmarks.first_hour.outcome import Context, Outcome",
            "context = Context(**json.loads(sys.argv[1]))",
            "step.end_together()",
            code,
        ]
        (tmp_path / "faked_step.py").write_text("\n".join(lines))
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
        monkeypatch.setattr(supervise, "MODULE", "faked_step")

    return make
