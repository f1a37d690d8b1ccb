"""A run of one machine leaves nothing of Ray behind, however its driver ends; what Ray raises is one line."""

import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import psutil
import pytest
import ray
from ray.exceptions import RaySystemError

from panolog.orchestrator.engine.cluster.connection import connect
from panolog.orchestrator.engine.cluster.failures import reported
from panolog.scene.errors import ClusterError, ClusterLostError, ConfigError
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

DRIVER = """
import os, signal, sys
from pathlib import Path
import ray
from panolog.orchestrator.engine.cluster.connection import connect

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

def work(): return os.nice(0)

with connect(None, Path(sys.argv[1]), nice=eval(sys.argv[2])):
    nicer = ray.get(ray.remote(work).remote()) - os.nice(0)  # there is a worker too
    store = ray.put(bytes(10**7))
    print(nicer, ray._private.worker._global_node.get_temp_dir_path(), file=sys.__stdout__, flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("end", "nice", "nicer"),
    [
        (signal.SIGKILL, None, 2),
        pytest.param(signal.SIGINT, 3, 3, marks=pytest.mark.nightly),  # as of a terminal
    ],
)
def test_nothing_is_left_and_workers_have_the_priority_that_is_wanted(
    tmp_path: Path, end: signal.Signals, nice: int | None, nicer: int
) -> None:
    command = [sys.executable, "-c", DRIVER, str(tmp_path), repr(nice)]
    ours, pipe = os.environ | {"RAY_worker_niceness": "2"}, subprocess.PIPE
    driver = subprocess.Popen(command, env=ours, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
    assert driver.stdout
    said, folder = driver.stdout.readline().split()
    assert int(said) == nicer
    assert Path(folder).is_dir()
    others = psutil.Process(driver.pid).children(recursive=True)
    assert len(others) > 6  # Ray's own, its agents, a worker, and the cleaner
    shared = {m.path for p in others for m in p.memory_maps() if m.path.startswith("/dev/shm/")}
    assert shared  # the object store
    if end == signal.SIGKILL:
        driver.kill()
    else:
        os.killpg(driver.pid, end)
    driver.communicate()
    assert driver.returncode == -end
    _, alive = psutil.wait_procs(others, timeout=120)
    assert not alive
    wait_until(lambda: not Path(folder).exists(), "the folder of Ray is removed")
    assert not [path for path in shared if Path(path).exists()]


@pytest.mark.parametrize(
    ("address", "nice", "why"),
    [
        ("auto", 5, "--nice 5: only for runs on this machine"),
        (None, None, "^RAY_worker_niceness=low: give a number from 0 to 19"),
    ],
)
def test_a_priority_that_cannot_be_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str | None, nice: int | None, why: str
) -> None:
    monkeypatch.setenv("RAY_worker_niceness", "low")
    with pytest.raises(ConfigError, match=why):
        connect(address, tmp_path, nice=nice).__enter__()


@pytest.mark.parametrize("slow", [1, 3])
def test_a_machine_too_busy_to_start_ray_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: int
) -> None:
    start, failed = ray.init, iter(range(slow))

    def init(**options: Any) -> None:
        if next(failed, None) is not None:
            message = "The current node timed out during startup. This could\nhappen"
            raise Exception(message)  # of that class
        start(**options)

    monkeypatch.setattr(ray, "init", init)
    wait, awaited = psutil.wait_procs, set[int]()

    def observed(processes: list[psutil.Process], timeout: float) -> Any:
        awaited.update(process.pid for process in processes)
        return wait(processes, timeout)

    monkeypatch.setattr(psutil, "wait_procs", observed)
    late = pytest.raises(ClusterError, match=r"^Ray does not start .* \(The current .* could\); end other")
    with subprocess.Popen(["sleep", "600"]) as other:
        try:
            with late if slow == 3 else nullcontext(), connect(None, tmp_path):
                assert ray.is_initialized()
        finally:
            other.kill()
    assert bool(awaited) == (slow == 1)
    assert other.pid not in awaited


def test_a_failure_of_ray_is_a_lost_cluster() -> None:
    @reported
    def fails() -> None:
        raise RaySystemError("Ray has not been started yet.")  # type: ignore[no-untyped-call]

    with pytest.raises(ClusterLostError, match=r"^Ray: System error: Ray has not been started yet\.$"):
        fails()
