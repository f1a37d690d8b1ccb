"""The preloaded library: errors, delays and another time, in exactly the given processes and folders."""

import errno
import os
import subprocess
import sys
import time
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


class Shimmed:
    """Processes with the library, and their faults."""

    def __init__(self, library: Path, folder: Path) -> None:
        self.control = Control(folder / "control")
        self._environment = {**os.environ, **self.control.environment(library)}

    def run(self, code: str, path: Path | None = None) -> str:
        """The last line of what a program prints or of its error; empty if it ended well."""
        command = [sys.executable, "-c", code, str(path)]
        done = subprocess.run(command, env=self._environment, capture_output=True, text=True, check=False)
        return (done.stdout + done.stderr).strip().rpartition("\n")[2]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        return build(tmp_path_factory.mktemp("library"))
    except RunError as error:
        pytest.skip(str(error))


@pytest.fixture
def shimmed(library: Path, tmp_path: Path) -> Shimmed:
    return Shimmed(library, tmp_path)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """One in the folder with the faults, one in a folder whose name begins alike."""
    both = tmp_path / "bad" / "file", tmp_path / "bad-not" / "file"
    for path in both:
        path.parent.mkdir()
        path.write_bytes(b"old")
    return both


def test_reads_below_a_folder_fail_as_often_as_wanted(shimmed: Shimmed, files: tuple[Path, Path]) -> None:
    inside, outside = files
    shimmed.control.add(Rule(inside.parent, READ, errno.ESTALE, times=1))
    assert shimmed.run(READS, outside) == shimmed.run(WRITES, inside) == ""
    assert os.strerror(errno.ESTALE) in shimmed.run(READS, inside)
    assert shimmed.run(READS, inside) == ""
    shimmed.control.add(Rule(inside.parent, READ, delay=0.2))
    assert float(shimmed.run(TIMED, inside)) >= 0.4  # open, then read
    for _ in range(2):
        shimmed.control.add(Rule(inside.parent, READ, errno.EIO))
    with pytest.raises(RunError, match="at most 4"):
        shimmed.control.add(Rule(inside.parent, READ, errno.EIO))


def test_a_full_disk_is_full_until_the_fault_is_lifted(shimmed: Shimmed, files: tuple[Path, Path]) -> None:
    inside, outside = files
    number = shimmed.control.add(Rule(inside.parent, WRITE, errno.ENOSPC))
    no_space = "No space left on device"
    for code, name, error in (
        (WRITES, "file", no_space),
        (WRITES, "new", no_space),
        (INSERTS, "database", "database or disk is full"),
    ):
        assert error in shimmed.run(code, inside.with_name(name))
        assert shimmed.run(code, outside.with_name(name)) == ""
    assert shimmed.run(READS, inside) == ""
    shimmed.control.lift(number)
    assert shimmed.run(WRITES, inside) == shimmed.run(INSERTS, inside.with_name("database")) == ""
    assert inside.read_bytes() == b"new"


def test_the_wall_clock_jumps_and_the_monotonic_one_does_not(shimmed: Shimmed) -> None:
    for offset in (36_000, -36_000):
        shimmed.control.move_clock(offset)
        seen = float(shimmed.run("import time; print(time.time())"))
        assert seen - time.time() == pytest.approx(offset, abs=3600)
        assert 0.1 <= float(shimmed.run(WAITS)) < 3600
