"""A run of one machine leaves nothing of Ray behind, however its driver ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

pytestmark = pytest.mark.system

DRIVER = """
import signal, sys
from pathlib import Path
import ray
from panolog.orchestrator.cluster.connection import connect

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

def work(): return 1

with connect(None, Path(sys.argv[1])):
    ray.get(ray.remote(work).remote())  # so that there is a worker too
    store = ray.put(bytes(10**7))
    print(ray._private.worker._global_node.get_temp_dir_path(), file=sys.__stdout__, flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(("end", "code"), [("of itself", 0), ("killed", -9), ("terminal", -2)])
def test_nothing_is_left(tmp_path: Path, end: str, code: int) -> None:
    command = [sys.executable, "-c", DRIVER, str(tmp_path)]
    driver = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert driver.stdout
    folder = driver.stdout.readline().strip()
    assert Path(folder).is_dir()
    others = psutil.Process(driver.pid).children(recursive=True)
    assert len(others) > 6  # Ray's own, its agents, a worker, and the cleaner
    shared = {m.path for p in others for m in p.memory_maps() if m.path.startswith("/dev/shm/")}
    assert shared  # the object store
    if end == "killed":
        driver.kill()
    elif end == "terminal":
        os.killpg(driver.pid, signal.SIGINT)
    driver.communicate()
    assert driver.returncode == code
    _, alive = psutil.wait_procs(others, timeout=30)
    assert not alive
    assert not Path(folder).exists()
    assert not [path for path in shared if Path(path).exists()]
