"""A run of one machine leaves nothing of Ray behind, however its driver ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

DRIVER = """
import sys
from pathlib import Path
import ray
from panolog.orchestrator.ray_connect import connect

def work(): return 1

with connect(None, Path(sys.argv[1])):
    ray.get(ray.remote(work).remote())  # so that there is a worker too
    store = ray.put(bytes(10**7))
    print(ray._private.worker._global_node.get_temp_dir_path(), file=sys.__stdout__, flush=True)
    sys.stdin.read()
"""
SHARED = Path("/dev/shm")


def those_of(folder: str) -> list[psutil.Process]:
    """The processes of a session of Ray, and who cleans up after it."""
    found = []
    for process in psutil.process_iter():
        try:
            if any(folder in argument for argument in process.cmdline()):
                found.append(process)
        except psutil.Error:
            continue
    return found


@pytest.mark.parametrize("end", ["of itself", "killed", "terminal"])
def test_nothing_is_left(tmp_path: Path, end: str) -> None:
    before = set(SHARED.iterdir())
    command = [sys.executable, "-c", DRIVER, str(tmp_path)]
    driver = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert driver.stdout
    folder = driver.stdout.readline().strip()
    assert Path(folder).is_dir()
    others = those_of(folder)
    assert len(others) > 3
    if end == "killed":
        driver.kill()
    elif end == "terminal":
        os.killpg(driver.pid, signal.SIGINT)
    driver.communicate()
    psutil.wait_procs(others, timeout=60)
    assert not those_of(folder)
    assert not Path(folder).exists()
    assert set(SHARED.iterdir()) <= before
