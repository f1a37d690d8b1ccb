"""The preloaded library: errors, delays and another time, in exactly the given processes and folders."""

import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.chaos.shim import READ, WRITE, Control, Rule, build
from panolog.scene.errors import RunError

pytestmark = pytest.mark.nightly

READS = "from pathlib import Path; import sys; Path(sys.argv[1]).read_bytes()"
WRITES = "from pathlib import Path; import sys; Path(sys.argv[1]).write_bytes(b'new')"
TIMED = f"import time; began = time.monotonic(); {READS}; print(time.monotonic() - began)"
INSERTS = """
import sqlite3, sys
with sqlite3.connect(sys.argv[1]) as connection:
    connection.execute("CREATE TABLE IF NOT EXISTS made (id)")
"""
WAITS = """
import threading, time
lock = threading.Lock()
lock.acquire()
began = time.monotonic()
lock.acquire(timeout=0.1)
print(time.monotonic() - began)
"""


@pytest.fixture
def control(tmp_path: Path) -> Control:
    return Control(tmp_path / "control")


@pytest.fixture
def run(control: Control, tmp_path: Path) -> Callable[..., str]:
    """Runs code with the library: the last line that it prints or of its error; empty if it ended well."""
    try:
        environment = os.environ | control.environment(build(tmp_path))
    except RunError as error:
        pytest.skip(str(error))

    def work(code: str, path: Path | None = None) -> str:
        command = [sys.executable, "-c", code, str(path)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        return (done.stdout + done.stderr).strip().rpartition("\n")[2]

    return work


def test_reads_and_writes_below_a_folder_fail_until_the_fault_is_lifted(
    run: Callable[..., str], control: Control, tmp_path: Path
) -> None:
    inside, outside = tmp_path / "bad" / "file", tmp_path / "bad-not" / "file"
    for path in (inside, outside):
        path.parent.mkdir()
        path.write_bytes(b"old")
    control.add(Rule(inside.parent, READ, errno.ESTALE, times=1))
    assert run(READS, outside) == run(WRITES, inside) == ""
    assert os.strerror(errno.ESTALE) in run(READS, inside)
    assert run(READS, inside) == ""
    number = control.add(Rule(inside.parent, WRITE, errno.ENOSPC))
    for code, name in ((WRITES, "file"), (WRITES, "new"), (INSERTS, "database")):
        error = run(code, inside.with_name(name))
        assert "No space left on device" in error or "database or disk is full" in error
        assert run(code, outside.with_name(name)) == ""
    assert run(READS, inside) == ""
    control.lift(number)
    assert run(WRITES, inside) == run(INSERTS, inside.with_name("database")) == ""
    control.add(Rule(inside.parent, READ, delay=0.2))
    assert float(run(TIMED, inside)) >= 0.4  # open, then read


def test_the_wall_clock_jumps_and_the_monotonic_one_does_not(
    run: Callable[..., str], control: Control
) -> None:
    for offset in (36_000, -36_000):
        control.move_clock(offset)
        assert float(run("import time; print(time.time())")) - time.time() == pytest.approx(offset, abs=3600)
        assert 0.1 <= float(run(WAITS)) < 3600
