"""A Ray cluster of two nodes on this machine, of which the second may be killed."""

import ctypes
import os
import secrets
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from benchmarks.runs import BIN
from panolog.scene.errors import RunError

_RECOVERY = Path(__file__).parents[2] / "deploy" / "recovery.env"  # how soon Ray notices a lost process
_TMP = "/tmp"  # not below TMPDIR: the paths of Ray's sockets have at most 107 characters
_NO_WORK = ("ray::IDLE", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl(2)
_TIMEOUT_S = 60.0  # for a node to start, and for processes to end
_POLL_S = 0.05  # between two checks of a process table or a port


def environment(token: str) -> dict[str, str]:
    """Environment of nodes and drivers: ours without Ray's variables, one thread, and deploy/recovery.env."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    lines = [line for line in _RECOVERY.read_text().splitlines() if line and not line.startswith("#")]
    recovery = dict(line.split("=", 1) for line in lines)
    path = f"{BIN}:{os.environ['PATH']}"
    fixed = {"PATH": path, "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    return ours | recovery | fixed | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token}


@contextmanager
def two_nodes() -> Iterator["TwoNodes"]:
    """The cluster for as long as the context lasts. Raises RunError if it does not start."""
    # The children of a killed node or driver become ours, so that we can wait for them and end them.
    ctypes.CDLL(None).prctl(_SUBREAPER, 1)
    with TemporaryDirectory(prefix="chaos-", dir=_TMP, ignore_cleanup_errors=True) as folder:
        cluster = TwoNodes(Path(folder))
        try:
            cluster.start()
            yield cluster
        finally:
            end_children()


class TwoNodes:
    """A head and a second node with one core each."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (self._port,) = free_ports(1)
        self.environment = environment(secrets.token_hex(32))  # of all processes of the cluster
        self._head: subprocess.Popen[bytes]
        self._second: subprocess.Popen[bytes]

    @property
    def address(self) -> str:
        """Of the cluster, for `--address`."""
        return f"127.0.0.1:{self._port}"

    def start(self) -> None:
        """Both nodes. Raises RunError if one does not start."""
        head = ("--head", f"--port={self._port}", "--include-dashboard=false", f"--temp-dir={self._folder}")
        self._head = self._node("head", *head)
        end = time.monotonic() + _TIMEOUT_S
        while not _answers(self._port):
            if self._head.poll() is not None or time.monotonic() > end:
                raise RunError(f"the Ray head did not start; see {self._folder}")
            time.sleep(_POLL_S)
        self.start_second()

    def start_second(self) -> None:
        """The second node, again if it was killed; returns before it has joined."""
        self._second = self._node("second", f"--address={self.address}")

    def kill_second(self) -> float:
        """SIGKILL for the raylet of the second node, and so for its workers; returns the time of the kill."""
        _raylet(self._second).kill()
        killed = time.time()
        self._second.wait(_TIMEOUT_S)  # `ray start --block` ends with its raylet
        return killed

    def wait_for_second(self) -> None:
        """Until the second node has a raylet. Raises RunError if it gets none."""
        _raylet(self._second)

    def kill_worker(self, choice: float) -> bool:
        """SIGKILL for a busy worker; returns whether there was one.

        Args: choice in [0, 1), which of several.
        """
        workers = [process for process in psutil.Process().children(recursive=True) if _busy(process)]
        try:
            workers[int(choice * len(workers))].kill()
        except (IndexError, psutil.NoSuchProcess):  # none, or one that has just ended
            return False
        return True

    def _node(self, name: str, *options: str) -> subprocess.Popen[bytes]:
        agent, metrics = free_ports(2)
        command = [str(BIN / "ray"), "start", "--block", "--num-cpus=1"]
        command += ["--object-store-memory=100000000", "--min-worker-port=0", "--max-worker-port=0"]
        command += [f"--dashboard-agent-listen-port={agent}", f"--metrics-export-port={metrics}", *options]
        with (self._folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)


def _raylet(node: subprocess.Popen[bytes]) -> psutil.Process:
    end = time.monotonic() + _TIMEOUT_S
    while node.poll() is None and time.monotonic() < end:
        for process in psutil.Process(node.pid).children(recursive=True):
            if process.name() == "raylet":
                return process
        time.sleep(_POLL_S)
    raise RunError("the second Ray node did not start")


def _busy(process: psutil.Process) -> bool:
    """Whether it is a worker with a task or an actor: Ray puts that into its title."""
    try:
        title, *_ = process.cmdline() or [""]
    except psutil.Error:
        return False  # it has just ended
    return title.startswith("ray::") and not title.startswith(_NO_WORK)


def _answers(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def free_ports(count: int) -> list[int]:
    """Ports that no process listens on, all different."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def end_children() -> None:
    """Ends all processes below this one, also those that their parents have left behind."""
    while processes := psutil.Process().children(recursive=True):
        for process in processes:
            process.kill()
        psutil.wait_procs(processes, timeout=_TIMEOUT_S)
