"""Workers on Ray: tasks go in, messages come out. The only module that knows Ray.

Each task is a remote generator; what it yields arrives in order while it runs. The scene and the Stage I
model are put into the object store once and shared by all tasks.
"""

import logging
import os
import shutil
import signal
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil

from panolog.orchestrator.machine import cores, memory
from panolog.orchestrator.policy import Machine, Share
from panolog.renderer.process import prepare
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import Locate, here
from panolog.workers.events import Event

# Read by Ray when it is imported: nothing is sent anywhere, and a machine without GPU is no reason to warn.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
from ray.exceptions import (
    NodeDiedError,
    OutOfMemoryError,
    RayError,
    RayTaskError,
    WorkerCrashedError,
)

from panolog.orchestrator.node_files import FileSharing, NodeFiles, Parcel, work_with

_UNREAD = 8  # events a worker may be ahead of the driver, so that checkpoints do not pile up in memory
_TMP = Path("/tmp")  # not below TMPDIR: the paths of Ray's sockets have at most 107 characters
_FOLDER = "panolog-ray-"
_ANSWER = 10.0  # seconds in which a cluster must answer, and Ray's own processes must end
_STORE = 2**31  # bytes of shared memory for the object store, at most; beyond it Ray spills to disk

_DEATHS: dict[type[RayError], str] = {
    WorkerCrashedError: "the worker process died: killed, out of memory, or crashed",
    NodeDiedError: "the worker's machine died or cannot be reached",
    OutOfMemoryError: "the worker's machine ran out of memory and Ray ended the worker",
}

Work = Callable[..., Iterator[Event]]


@dataclass(frozen=True)
class Hello:
    """The first message of a task: where it runs."""

    node: str
    pid: int


@dataclass(frozen=True)
class Ended:
    """The last message of a task that ran to its end."""


@dataclass(frozen=True)
class Failed:
    """The last message of a task that did not."""

    reason: str  # one line
    user_error: bool  # an InputError: trying again is pointless
    detail: str = ""  # the traceback of what nobody has foreseen


Message = Hello | Event | Ended | Failed


class RayPool:
    """The tasks that run now. Made by `connect`."""

    def __init__(self, machine: Machine, sharing: FileSharing | None) -> None:
        self.machine = machine
        self._sharing = sharing  # None where all tasks run on this machine
        self._running: dict[str, ray.ObjectRefGenerator] = {}

    def put(self, value: object) -> Any:
        """Shares a value with all tasks: hand the result to `start` in its place."""
        ref = ray.put(value)
        return ref if self._sharing is None else Parcel(ref)

    def share_files(self, root: Path, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene, and files that the run in the folder `root` has made.

        Raises OSError if one of them is gone.
        """
        return here if self._sharing is None else self._sharing.share_files(root, scene, run)

    def start(self, name: str, share: Share, work: Work, fields: dict[str, Any]) -> None:
        """Runs `work(**fields)` on a worker as soon as its share is free; tasks wait in order."""
        remote = ray.remote(_run).options(
            num_cpus=share.cpus,
            num_gpus=share.gpus,
            num_returns="streaming",
            max_retries=0,
            _generator_backpressure_num_objects=_UNREAD,
        )
        self._running[name] = remote.remote(work, share.cpus, **fields)

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        """The next message of every task that has one; waits at most `seconds` for the first."""
        generators = list(self._running.values())
        if not generators:
            return []
        ray.wait(generators, num_returns=1, timeout=seconds)
        some, _ = ray.wait(generators, num_returns=len(generators), timeout=0)
        names = {id(generator): name for name, generator in self._running.items()}
        messages = [(names[id(generator)], _next(generator)) for generator in some]
        for name, message in messages:
            if isinstance(message, Ended | Failed):
                del self._running[name]
        return messages


@contextmanager
def connect(address: str | None) -> Iterator[RayPool]:
    """Ray for as long as the context lasts: a cluster's at `address`, or one of its own on this machine.

    Raises InputError if there is no cluster at the address.
    """
    with ExitStack() as stack:
        _sweep()
        prefix = f"{_FOLDER}{os.getpid()}-"
        own = TemporaryDirectory(prefix=prefix, dir=_TMP, ignore_cleanup_errors=True)
        folder = stack.enter_context(own)
        stack.callback(_shut_down)
        _join(address) if address else _start(folder)
        # Ray has put a handler of its own for SIGTERM: let it be a Ctrl-C, so that the run says how it ended.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sharing = FileSharing() if address else None
        yield RayPool(_machine(None if address else memory()), sharing)
        if sharing is not None:
            sharing.clear()


def _join(address: str) -> None:
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if address != "auto" and not (colon and port.isdecimal()):
        raise InputError(f"--address {address}: write auto or HOST:PORT")
    try:
        if address != "auto":  # Ray itself would try for two minutes
            socket.create_connection((host, int(port)), timeout=_ANSWER).close()
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
    except (OSError, OverflowError) as error:  # ConnectionError is an OSError
        raise InputError(
            f"--address {address}: no Ray cluster answers there ({_line(str(error))});"
            " one that asks for a token needs RAY_AUTH_MODE=token here"
        ) from error


def _machine(memory: int | None) -> Machine:
    """What the nodes that are there have together, and each by itself."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
    cpus = [int(node.get("CPU", 0)) for node in nodes]
    gpus = [int(node.get("GPU", 0)) for node in nodes]
    per_gpu = [cpu // gpu for cpu, gpu in zip(cpus, gpus, strict=True) if gpu]
    return Machine(sum(cpus), max(cpus), sum(gpus), min(per_gpu, default=0), memory)


def _shut_down() -> None:
    """Ends Ray and waits until its processes have stopped to write."""
    processes = psutil.Process().children(recursive=True)
    ray.shutdown()
    psutil.wait_procs(processes, timeout=_ANSWER)


def _sweep() -> None:
    """Removes the folders of sessions whose driver was killed."""
    for folder in _TMP.glob(f"{_FOLDER}*-*"):
        driver = folder.name.removeprefix(_FOLDER).partition("-")[0]
        if driver.isdecimal() and not psutil.pid_exists(int(driver)):
            shutil.rmtree(folder, ignore_errors=True)


def _start(folder: str) -> None:
    ray.init(
        address="local",  # whatever RAY_ADDRESS says
        num_cpus=cores(),
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
        object_store_memory=min(_STORE, memory() // 4),
        _temp_dir=folder,
    )


def _run(work: Work, threads: int, **fields: Any) -> Iterator[Hello | Event]:
    """What runs on the worker."""
    os.environ["OMP_NUM_THREADS"] = str(threads)
    prepare(threads)
    yield Hello(socket.gethostname(), os.getpid())
    files = fields["locate"]
    yield from work_with(files, work, fields) if isinstance(files, NodeFiles) else work(**fields)


def _next(generator: Any) -> Message:
    try:
        message: Message = ray.get(next(generator))
    except StopIteration:
        return Ended()
    except RayTaskError as error:
        cause = error.cause
        known = isinstance(cause, PanologError)
        reason = str(cause) if known else f"{type(cause).__name__}: {cause}"
        return Failed(_line(reason), isinstance(cause, InputError), "" if known else error.traceback_str)
    except RayError as error:
        return Failed(_DEATHS.get(type(error)) or f"Ray: {_line(str(error))}", False, str(error))
    return message


def _line(text: str) -> str:
    """The first line of a text."""
    return (text.strip().splitlines() or [""])[0]
