"""The check after each test finds each kind of thing that a test can leave, by the name of the test."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import leaks

LEAKS = {
    "process": 'subprocess.Popen(["sleep", "600"])',
    "zombie": 'kept.append(process := subprocess.Popen(["true"])); os.waitid(os.P_PID, process.pid, ENDED)',
    "thread": "threading.Thread(target=threading.Event().wait, daemon=True).start()",
    "listening socket tcp": 'kept.append(socket.create_server(("127.0.0.1", 0)))',
    "listening socket unix": 'kept.append(one := socket.socket(socket.AF_UNIX)); one.bind(""); one.listen()',
    "temporary file": "tempfile.mkdtemp()",
    "orphan": 'subprocess.run(["sh", "-c", "sleep 600 &"], stdout=subprocess.DEVNULL)',
    "shared memory": "one = SharedMemory(create=True, size=64); one.close(); atexit.register(one.unlink)",
}
FILE = """
import atexit, os, socket, subprocess, tempfile, threading
from multiprocessing.shared_memory import SharedMemory

import pytest

ENDED = os.WEXITED | os.WNOWAIT
kept = []

@pytest.fixture(scope="module")
def shared():
    process = subprocess.Popen(["sleep", "600"])
    yield
    process.kill()
    process.wait()

def test_with_what_a_file_shares(shared):
    subprocess.run(["true"])

def test_leaves(shared):
    {leak}
"""


def main(folder: str) -> int:
    """Runs the tests of a folder with the check, without much patience."""
    leaks.WAIT_S = 0.2

    class Plugin:
        def pytest_configure(self, config: pytest.Config) -> None:
            leaks.configure(config)

    return int(
        pytest.main([folder, "-q", "-p", "no:cacheprovider", f"--rootdir={folder}"], plugins=[Plugin()])
    )


def test_every_kind_of_leak_is_found_by_its_name(tmp_path: Path) -> None:
    for number, leak in enumerate(LEAKS.values()):
        (tmp_path / f"test_{number}.py").write_text(FILE.format(leak=leak))
    (tmp_path / "test_without.py").write_text(FILE.format(leak="pass"))
    command = [sys.executable, "-c", f"from tests.test_leaks import main; main({str(tmp_path)!r})"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    lines = [line for line in ended.stdout.splitlines() if line.startswith("leaves ")]
    assert len(lines) == len(LEAKS), ended.stdout
    for line, kind in zip(lines, LEAKS, strict=True):
        assert kind in line
    assert f"{len(LEAKS) * 2 + 2} passed, {len(LEAKS)} errors" in ended.stdout
