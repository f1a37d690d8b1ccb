"""A Ray cluster of several nodes on this machine, of which all processes may fail."""

import ctypes
import os
import secrets
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from benchmarks.chaos.cable import Cable, laid
from benchmarks.chaos.shim import Control, build
from benchmarks.runs import BIN
from panolog.scene.errors import RunError

HEAD, SECOND, DRIVER = GROUPS = "head", "second", "driver"  # of processes that have faults in common
THIRD, FOURTH = "third", "fourth"
_RECOVERY = Path(__file__).parents[2] / "deploy" / "recovery.env"  # how soon Ray notices a lost process
_TMP = "/tmp"  # not below TMPDIR: the paths of Ray's sockets have at most 107 characters
_NO_WORK = ("ray::IDLE", "ray::Agent", "ray::DashboardAgent", "ray::RuntimeEnvAgent")
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl(2)
_TIMEOUT_S = 120.0  # for a node to start, and for processes to end
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
def two_nodes(hidden: Path) -> Iterator["LocalCluster"]:
    """The cluster for as long as the context lasts. Raises RunError if it does not start.

    Args: hidden, a folder that the second node does not see, if namespaces can be made.
    """
    with laid(hidden) as cable, started(cable, {HEAD: 1, SECOND: 1}) as cluster:
        yield cluster


@contextmanager
def started(
    cable: Cable | None, cores: Mapping[str, int], variables: Mapping[str, Mapping[str, str]] | None = None
) -> Iterator["LocalCluster"]:
    """A cluster for as long as the context lasts. Args: as `LocalCluster`. Raises as `two_nodes`."""
    # The children of a killed node or driver become ours, so that we can wait for them and end them.
    ctypes.CDLL(None).prctl(_SUBREAPER, 1)
    with TemporaryDirectory(prefix="chaos-", dir=_TMP, ignore_cleanup_errors=True) as folder:
        cluster = LocalCluster(Path(folder), cable, cores, variables or {})
        try:
            cluster.keep()
            cluster.wait()
            yield cluster
        finally:
            end_children()


class LocalCluster:
    """A head and other nodes, whose processes take faults, as do drivers."""

    def __init__(
        self,
        folder: Path,
        cable: Cable | None,
        cores: Mapping[str, int],
        variables: Mapping[str, Mapping[str, str]],
    ) -> None:
        """The second node is at the end of the cable if there is one.

        Args: cores of each node by its name, HEAD first; variables, environment of nodes besides.
        Raises RunError if the library of `shim` cannot be built.
        """
        self._folder = folder
        self.cable = cable
        (self._port,) = free_ports(1)
        self._environment = environment(secrets.token_hex(32))
        self._library = build(folder)
        self._cores, self._variables = cores, variables
        self.controls = {name: Control(folder / f"{name}.control") for name in (*cores, DRIVER)}
        self._nodes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def address(self) -> str:
        """Of the cluster, for `--address`."""
        return f"{self._host}:{self._port}"

    @property
    def _host(self) -> str:
        return self.cable.near if self.cable else "127.0.0.1"

    @property
    def copies(self) -> Path | None:
        """Where the second node has its copies of files that it does not see; None if it sees all."""
        return self._folder / "panolog" if self.cable else None

    def environment(self, group: str) -> dict[str, str]:
        """Of a node or of DRIVER."""
        faults = self.controls[group].environment(self._library)
        return {**self._environment, **faults, **self._variables.get(group, {})}

    def keep(self) -> None:
        """Starts the nodes that do not run, as a service manager would; returns before they have joined."""
        for name in self._cores:
            if name not in self._nodes or self._nodes[name].poll() is not None:
                self._start(name)

    def wait(self) -> None:
        """Until all nodes have joined. Raises RunError if one does not."""
        end = time.monotonic() + _TIMEOUT_S
        while not (_answers(self._host, self._port) and all(map(self.raylet, self._cores))):
            if time.monotonic() > end:
                raise RunError(f"the Ray cluster did not start; see {self._folder}")
            time.sleep(_POLL_S)
            self.keep()

    def raylet(self, node: str = SECOND) -> psutil.Process | None:
        """That of a node; without it, the node ends."""
        return self._process(node, "raylet")

    def node_id(self, node: str) -> str:
        """Node.id of a node; "" if it does not run now."""
        raylet, option = self.raylet(node), "--node_id="
        with suppress(psutil.Error):
            words = raylet.cmdline() if raylet else ()
            return next((word.removeprefix(option) for word in words if word.startswith(option)), "")
        return ""

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
        host = self._host
        options = ["--head", f"--port={self._port}", f"--temp-dir={self._folder}"]
        options.append("--include-dashboard=false")
        enter: Sequence[str] = ()
        if name != HEAD:
            options = [f"--address={self.address}"]
        if name == SECOND and self.cable:
            host, enter = self.cable.far, self.cable.enter
        agent, metrics = free_ports(2)
        command = [*enter, str(BIN / "ray"), "start", "--block", f"--node-ip-address={host}"]
        command += [f"--num-cpus={self._cores[name]}", "--object-store-memory=100000000"]
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
            with suppress(psutil.NoSuchProcess):  # its parent has waited for it meanwhile
                process.kill()
        psutil.wait_procs(processes, timeout=_TIMEOUT_S)
