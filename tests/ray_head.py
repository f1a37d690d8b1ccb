"""Ray on this machine: a head with its job server, metrics and a token, and what clusters have in common."""

import ctypes
import os
import secrets
import select
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
import pytest

BIN = Path(sys.executable).parent
_ROOT = Path(__file__).parents[1]
_RECOVERY = _ROOT / "deploy" / "recovery.env"  # how soon Ray notices a lost process
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl(2)
_TIMEOUT_S = 120.0  # for processes to end
_REPORTS = '{"metrics_report_interval_ms": 500}'


@dataclass(frozen=True)
class Head:
    """Where the head is reached, and with what."""

    address: str  # of its job server
    metrics: str  # URL of what Prometheus reads
    token: str = field(repr=False)

    @property
    def environment(self) -> dict[str, str]:
        """That of a process which may use it."""
        return environment() | {"RAY_AUTH_TOKEN": self.token}


def environment() -> dict[str, str]:
    """Ours without what it says of Ray, and with the programs of this Python on the path."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    return ours | {
        "PATH": f"{BIN}:{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_worker_niceness": "0",  # by Ray's default of 15, workers starve under load
    }


def recovery() -> dict[str, str]:
    """The settings that deploy/ recommends."""
    lines = _RECOVERY.read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))


def cluster_environment() -> dict[str, str]:
    """That of the nodes and drivers of a new cluster: with a token of its own and the settings of deploy/."""
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    return environment() | recovery() | token


def free_ports(count: int) -> list[int]:
    """Ports that no process listens on, all different."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


@contextmanager
def all_end() -> Iterator[None]:
    """Ends all processes that begin meanwhile below this one, also those that their parents leave behind."""
    resource_tracker.ensure_running()  # which serves this process until its end
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    prctl = ctypes.CDLL(None).prctl
    prctl(_SUBREAPER, 1)  # orphans become ours, so that we can wait for them
    try:
        yield
    finally:
        while new := [it for it in psutil.Process().children(recursive=True) if it.pid not in before]:
            for process in new:
                with suppress(psutil.NoSuchProcess):  # its parent has waited for it meanwhile
                    process.kill()
            psutil.wait_procs(new, timeout=_TIMEOUT_S)
        prctl(_SUBREAPER, 0)


@contextmanager
def started(command: Sequence[str | Path], environment: dict[str, str], log: Path) -> Iterator[None]:
    """A command below a process that reaps all that it leaves behind; with the context all of it ends."""
    keeper = (sys.executable, "-m", "tests.ray_head", *command)
    with log.open("w") as said:
        process = subprocess.Popen(
            keeper, env=environment, stdin=subprocess.PIPE, stdout=said, stderr=said, cwd=_ROOT
        )
        try:
            yield
        finally:
            process.communicate(timeout=2 * _TIMEOUT_S)


def _keep() -> None:
    """Runs the command of this process, and reaps what ends below it, until standard input ends."""
    with all_end():
        subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
        while not select.select([sys.stdin], [], [], 0.1)[0]:
            with suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def living(word: str, parent: int | None = None) -> list[psutil.Process]:
    """Children of a process, by default of this one, with a word in their command line, but no zombies."""
    found = []
    for child in psutil.Process(parent).children():
        with suppress(psutil.Error):  # it ends meanwhile
            if word in child.cmdline() and child.status() != psutil.STATUS_ZOMBIE:
                found.append(child)
    return found


def wait_until(holds: Callable[[], object], what: str, seconds: float = 300) -> None:
    """Looks until it holds; fails the test when that takes too long."""
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            pytest.fail(f"after {seconds:.0f} s not yet: {what}")
        time.sleep(0.1)


def read(url: str) -> str:
    """What a server says; nothing while there is none."""
    try:
        with urllib.request.urlopen(url, timeout=60) as reply:
            text: str = reply.read().decode()
    except OSError:
        return ""
    return text


@contextmanager
def ray_head() -> Iterator[Head]:
    """A head with two cores, as long as the context lasts; nothing of it is left."""
    gcs, dashboard, metrics, agent, client = free_ports(5)
    head = Head(f"http://127.0.0.1:{dashboard}", f"http://127.0.0.1:{metrics}/metrics", secrets.token_hex(32))
    with TemporaryDirectory(prefix="ray-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        command = ["ray", "start", "--head", "--block", "--disable-usage-stats", "--num-cpus=2"]
        command += ["--include-dashboard=true", f"--temp-dir={folder}", f"--system-config={_REPORTS}"]
        command += [f"--port={gcs}", f"--dashboard-port={dashboard}", f"--metrics-export-port={metrics}"]
        command += [f"--dashboard-agent-listen-port={agent}", f"--ray-client-server-port={client}"]
        command += ["--min-worker-port=0", "--max-worker-port=0", "--object-store-memory=80000000"]
        ours = head.environment | {"RAY_AUTH_MODE": "token"}
        with started(command, ours, Path(folder, "start.log")):
            wait_until(lambda: read(f"{head.address}/api/gcs_healthz"), "the head is up")
            yield head


if __name__ == "__main__":
    _keep()
