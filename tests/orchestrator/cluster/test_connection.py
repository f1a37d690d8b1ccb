"""A run of one machine leaves nothing of Ray behind, however its driver ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.cluster.connection import connect
from panolog.scene.errors import ConfigError

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


PRIORITY = """
import os, sys
from pathlib import Path
import ray
from panolog.orchestrator.cluster.connection import connect

def niceness(): return os.nice(0) - outer

outer = os.nice(0)
with connect(None, Path(sys.argv[1]), nice=eval(sys.argv[2])):
    print(ray.get(ray.remote(niceness).remote()), file=sys.__stdout__)
"""


@pytest.mark.parametrize(("nice", "own", "expected"), [(None, None, 0), (None, "2", 2), (3, "2", 3)])
def test_workers_have_the_priority_of_the_driver_or_as_wanted(
    tmp_path: Path, nice: int | None, own: str | None, expected: int
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "RAY_worker_niceness"}
    command = [sys.executable, "-c", PRIORITY, str(tmp_path), repr(nice)]
    extra = {"RAY_worker_niceness": own} if own else {}
    done = subprocess.run(command, env=environment | extra, capture_output=True, text=True, check=True)
    assert int(done.stdout) == expected


def test_nice_is_refused_with_a_cluster(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--nice 5: only for runs on this machine"):
        connect("auto", tmp_path, nice=5).__enter__()
