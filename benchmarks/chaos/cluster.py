"""A Ray cluster of several nodes on this machine, of which all processes may fail."""

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from benchmarks.chaos.shim import Control, build
from panolog.scene.errors import RunError
from tests.ray_head import BIN, all_end, cluster_environment, free_ports

HEAD, SECOND, DRIVER = GROUPS = "head", "second", "driver"  # of processes that have faults in common
_NODES = HEAD, SECOND
_HOST = "127.0.0.1"
_TMP = "/tmp"  # not below TMPDIR: the paths of Ray's sockets have at most 107 characters
_NO_WORK = ("ray::IDLE", "ray::Agent", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
_TIMEOUT_S = 600.0  # for a node to start, also on a busy machine
_AS_NICE = {"RAY_worker_niceness": "0"}  # as this process: nicer ones starve next to other programs
_POLL_S = 0.05  # between two checks of a process table or a port


@contextmanager
def two_nodes() -> Iterator["LocalCluster"]:
    """The cluster for as long as the context lasts. Raises RunError if it does not start."""
    with TemporaryDirectory(prefix="chaos-", dir=_TMP, ignore_cleanup_errors=True) as folder:
        cluster = LocalCluster(Path(folder))
        with all_end():  # the children of a killed node or driver too
            cluster.keep()
            cluster.wait()
            yield cluster


class LocalCluster:
    """A head and a second node of one core each, whose processes take faults, as do drivers."""

    def __init__(self, folder: Path) -> None:
        """Raises RunError if the library of `shim` cannot be built."""
        self._folder = folder
        (self._port,) = free_ports(1)
        self._environment = cluster_environment() | _AS_NICE
        self._library = build(folder)
        self.controls = {name: Control(folder / f"{name}.control") for name in GROUPS}
        self._nodes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def address(self) -> str:
        """Of the cluster, for `--address`."""
        return f"{_HOST}:{self._port}"

    def environment(self, group: str) -> dict[str, str]:
        """Of a node or of DRIVER."""
        return {**self._environment, **self.controls[group].environment(self._library)}

    def keep(self) -> None:
        """Starts the nodes that do not run, as a service manager would; returns before they have joined."""
        for name in _NODES:
            if name not in self._nodes or self._nodes[name].poll() is not None:
                self._start(name)

    def wait(self) -> None:
        """Until all nodes have joined. Raises RunError if one does not."""
        end = time.monotonic() + _TIMEOUT_S
        while not (_answers(_HOST, self._port) and all(map(self.raylet, _NODES))):
            if time.monotonic() > end:
                raise RunError(f"the Ray cluster did not start; see {self._folder}")
            time.sleep(_POLL_S)
            self.keep()

    def raylet(self, node: str = SECOND) -> psutil.Process | None:
        """That of a node; without it, the node ends."""
        return self._process(node, "raylet")

    def gcs(self) -> psutil.Process | None:
        """The head's record of the cluster; without it, the head ends."""
        return self._process(HEAD, "gcs_server")

    def busy_worker(self, choice: float) -> psutil.Process | None:
        """A worker with a task or an actor, on any node. Args: choice in [0, 1), which of several."""
        workers = [process for process in psutil.Process().children(recursive=True) if _busy(process)]
        return workers[int(choice * len(workers))] if workers else None

    def _process(self, node: str, name: str) -> psutil.Process | None:
        with suppress(psutil.NoSuchProcess):
            for process in psutil.Process(self._nodes[node].pid).children(recursive=True):
                if process.name() == name:
                    return process
        return None

    def _start(self, name: str) -> None:
        options = [f"--address={self.address}"]
        if name == HEAD:
            options = ["--head", f"--port={self._port}", f"--temp-dir={self._folder}"]
            options += ["--include-dashboard=false"]
        agent, metrics = free_ports(2)
        command = [str(BIN / "ray"), "start", "--block", f"--node-ip-address={_HOST}"]
        command += ["--num-cpus=1", "--object-store-memory=100000000"]
        command += ["--min-worker-port=0", "--max-worker-port=0"]
        command += [f"--dashboard-agent-listen-port={agent}", f"--metrics-export-port={metrics}", *options]
        with (self._folder / f"{name}.log").open("ab") as log:
            environment = self.environment(name)
            self._nodes[name] = subprocess.Popen(command, env=environment, stdout=log, stderr=log)


def _busy(process: psutil.Process) -> bool:
    """Whether it is a worker with a task or an actor: Ray puts that into its title."""
    try:
        title, *_ = process.cmdline() or [""]
    except psutil.Error:
        return False  # it has just ended
    return title.startswith("ray::") and not title.startswith(_NO_WORK)


def _answers(host: str, port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex((host, port)) == 0
