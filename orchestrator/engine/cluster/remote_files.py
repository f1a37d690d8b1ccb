"""Files of the driver's machine on the other machines of a cluster: no filesystem has to be shared.

A worker that sees a file at its own path reads it there. Any other requests it from the file server, an actor
on the driver's machine, once for each machine: the bytes travel through Ray's object store and are kept in
Ray's temporary folder. No object has to outlive the call that moves it: a lost one is requested again.
"""

import errno
import fcntl
import hashlib
import os
import shutil
import signal
import socket
import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import ray
from numpy.typing import NDArray
from ray.experimental import get_object_locations
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from panolog.orchestrator.engine.cluster.nodes import on_node
from panolog.orchestrator.engine.scheduling.large_messages import payload
from panolog.orchestrator.runs.machines.usage import Usage, measure
from panolog.scene.errors import RunError
from panolog.scene.files import atomic, write_bytes
from panolog.scene.stores.cache import Stored
from panolog.scene.stores.stored_scenes import remember, stored_of
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import Progress, Transfer

T = TypeVar("T")

_FOLDER = "panolog"  # in Ray's temporary folder
_READS = 4  # pieces of files that the server reads at a time
_PIECE = 2**26  # bytes sent at a time: a merged model may be larger than the object store
_SIGN_S = 20.0  # between two signs that files arrive
_ANSWER_S = 30.0  # in which the server must answer
_ANSWERS = "answers"  # the concurrency group of these: they do not wait for what it reads
_SPARE = 0.1  # of a disk, which copies leave free
_RECENT_S = 600.0  # since its last use, in which a copy stays: its task may be about to open it
_TIMEOUT_S = 10.0  # in which the machines must have removed their copies
_RECEIVED: deque[int] = deque()  # bytes of each transfer to this process that no event has reported yet


@dataclass(frozen=True)
class Stamp:
    """Identifies a version of a file."""

    size: int  # bytes
    modified: int | None = None  # ns since the epoch; None: the size will do, as in a scene's fingerprint

    @classmethod
    def of(cls, path: Path, *, dated: bool) -> "Stamp":
        """The stamp of a file. Raises OSError if there is none."""
        stat = path.stat()
        return cls(stat.st_size, stat.st_mtime_ns if dated else None)

    def fits(self, path: Path) -> bool:
        return path.is_file() and self == Stamp.of(path, dated=self.modified is not None)


class FileServer:
    """Reads files for the other machines; an actor on the driver's."""

    def __init__(self, process: Path) -> None:
        """Ray may start it several times. Args: process, a file that gets its process id."""
        process.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(process, str(os.getpid()).encode())

    @ray.method(concurrency_group=_ANSWERS)
    def answer(self) -> None:
        """Shows that it works, also while it reads."""

    def read(self, path: Path, stamp: Stamp, start: int, count: int) -> NDArray[np.uint8]:
        """At most `count` bytes of a file from `start` on. Raises RunError if it has changed or is gone."""
        if not stamp.fits(path):
            raise RunError(f"{path}: has changed on the driver's machine since the task was started")
        return np.fromfile(path, np.uint8, count, offset=start)


@dataclass(frozen=True)
class RayValue(Generic[T]):
    """A value in Ray's object store: a `Source`."""

    ref: Any  # ray.ObjectRef
    home: str  # Ray's id of the driver's machine

    def load(self) -> T:
        if _here() != self.home:
            copies = get_object_locations([self.ref]).get(self.ref, {})
            if _here() not in copies.get("node_ids", ()):
                _RECEIVED.append(copies.get("object_size") or 0)
        value: T = ray.get(self.ref)
        return value


@dataclass(eq=False)
class NodeFiles:
    """The `Locate` of a worker: some files of the driver's machine, wherever the worker is."""

    server: Any  # handle of a FileServer
    home: str  # Ray's id of the driver's machine
    cache: str  # name of the folder that has this machine's copies
    stamps: dict[Path, Stamp]
    stored: dict[Path, Stored]  # files of a scene in an object store, which every machine reads itself

    def __call__(self, path: Path) -> Path:
        """Where the file is on this machine; fetches it if it is not. Decoding threads may call it at once.

        Raises:
            KeyError: the file is not one of the task's.
            RunError: it has changed where the run is, or is gone.
            OSError: this machine cannot keep it.
        """
        if path in self.stored:
            remember(path, self.stored[path])
            return path
        stamp = self.stamps[path]
        if stamp.fits(path):
            return path
        copy = self._copy(path)
        copy.parent.mkdir(parents=True, exist_ok=True)
        with (copy.parent / "lock").open("w") as lock:  # of two tasks that want it at once one fetches
            fcntl.flock(lock, fcntl.LOCK_EX)
            os.utime(copy.parent / "lock")  # when it was used last
            if not copy.is_file():
                _make_room(copy, stamp.size)
                self._fetch(path, stamp, copy)
        return copy

    def made(self) -> list[Path]:
        """The files that the run has made, such as models and checkpoints: they may be large."""
        return [path for path, stamp in self.stamps.items() if stamp.modified is not None]

    def arrived(self, path: Path) -> int:
        """Bytes of a file that are here, or on their way into its copy, whichever task fetches it."""
        with suppress(FileNotFoundError):  # a piece has just become the copy
            return sum(piece.stat().st_size for piece in self._copy(path).parent.glob("*"))
        return 0

    def _copy(self, path: Path) -> Path:
        folder = Path(ray.get_runtime_context().get_temp_dir()) / _FOLDER / self.cache
        version = (str(path), self.stamps[path])
        digest = "-".join(hashlib.sha256(repr(it).encode()).hexdigest()[:16] for it in version)
        return folder / digest / path.name

    def _fetch(self, path: Path, stamp: Stamp, copy: Path) -> None:
        with atomic(copy) as temporary, temporary.open("wb") as file:
            for start in range(0, stamp.size, _PIECE):
                file.write(ray.get(self.server.read.remote(path, stamp, start, _PIECE)))
        _RECEIVED.append(stamp.size)


def key_of(root: Path) -> str:
    """A name for the run in a folder of this machine, the same in all its drivers."""
    return hashlib.sha256(f"{socket.gethostname()}:{root.resolve()}".encode()).hexdigest()[:16]


class FileSharing:
    """The driver's side: starts the file server when it is first needed, and clears up."""

    def __init__(self, root: Path) -> None:
        """For the run in the folder `root`: it finds the copies again that it has made before."""
        self._server: Any = None
        self._home: str = ray.get_runtime_context().get_node_id()
        self._cache = key_of(root)
        folder = Path(ray.get_runtime_context().get_temp_dir()) / _FOLDER
        self._process = folder / f"{self._cache}.server"  # a file with the id of the server's process
        self._asked: tuple[Any, float] | None = (
            None  # an answer of the server, and until when it must be here
        )

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> NodeFiles:
        if self._server is None:
            self._process.unlink(missing_ok=True)
            here = NodeAffinitySchedulingStrategy(self._home, soft=False)
            self._server = (
                ray.remote(concurrency_groups={_ANSWERS: 1})(FileServer)  # type: ignore[call-overload]
                .options(
                    num_cpus=0,
                    max_concurrency=_READS,
                    max_restarts=-1,
                    max_task_retries=-1,
                    scheduling_strategy=here,
                )
                .remote(self._process)
            )
        # A run's own files are replaced by others of the same size; a copy of a scene has times of its own.
        found = {path: stored_of(path) for path in scene}
        stored = {path: it for path, it in found.items() if it is not None}
        stamps = {path: Stamp.of(path, dated=False) for path, it in found.items() if it is None}
        stamps |= {path: Stamp.of(path, dated=True) for path in run}
        return NodeFiles(self._server, self._home, self._cache, stamps, stored)

    def suspect(self) -> None:
        """Requests an answer of the file server: a task has failed that may have waited for a file."""
        if self._server is not None and self._process.exists() and self._asked is None:
            self._asked = self._server.answer.remote(), time.monotonic() + _ANSWER_S

    def review(self) -> None:
        """Ends the file server if it is suspected and does not answer, without waiting for it.

        Ray starts it again, and repeats what was requested of it.
        """
        if self._asked is None:
            return
        answer, until = self._asked
        here, _ = ray.wait([answer], timeout=0)
        if not here and time.monotonic() < until:
            return
        self._asked = None
        if not here:
            with suppress(ProcessLookupError):
                os.kill(int(self._process.read_text()), signal.SIGKILL)

    def clear(self) -> None:
        """Removes the copies on all machines that can be reached. Until then a resumed run finds them."""
        nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
        removals = [
            on_node(_remove, node).remote(self._cache)
            for node in nodes
            if node != self._home and self._server is not None
        ]
        if removals:
            ray.wait(removals, num_returns=len(removals), timeout=_TIMEOUT_S)


def run_remotely(spec: TaskSpec) -> Iterator[Event | Calibration | Usage]:
    """What a spec yields, in a worker, with a Transfer event for the bytes that it moves between machines.

    One precedes each milestone, else another when the bytes have doubled: so a run has few of them. What the
    run has made is fetched first, with signs that it arrives: in a slow network that can take longer than a
    worker may be silent.
    """
    if not isinstance(spec.locate, NodeFiles):  # all tasks run on the driver's machine
        yield from spec.run()
        return
    remote = _here() != spec.locate.home
    _RECEIVED.clear()
    if remote:
        yield from _fetched(spec.locate)
    reported = received = sent = 0
    for event in spec.run():
        received += received_bytes()
        sent += payload(event) if remote else 0
        milestone = not isinstance(event, Progress)
        if received + sent > (0 if milestone else reported):
            yield Transfer(spec.task, received, sent)
            reported, received, sent = reported + received + sent, 0, 0
        yield event


def _fetched(files: NodeFiles) -> Iterator[Usage]:
    """Fetches what the run has made; yields as long as more of it arrives, every `_SIGN_S` seconds."""
    with ThreadPoolExecutor(1, "fetch") as thread:
        for path in files.made():
            fetch, before = thread.submit(files, path), 0
            while wait([fetch], _SIGN_S).not_done:  # an error comes again where the task opens the file
                if (arrived := files.arrived(path)) > before:
                    before = arrived
                    yield measure()


def received_bytes() -> int:
    """Bytes that this process has received from other machines since the last call."""
    return sum(_RECEIVED.popleft() for _ in range(len(_RECEIVED)))


def _here() -> str:
    node: str = ray.get_runtime_context().get_node_id()
    return node


def _make_room(copy: Path, size: int) -> None:
    """Removes copies of older versions of a file; while `_SPARE` of the disk is not free, also unused ones.

    Raises OSError if the disk then has no room for the new one.
    """
    of_path = copy.parent.name.partition("-")[0]
    for older in copy.parent.parent.glob(f"{of_path}-*"):
        if older != copy.parent:
            shutil.rmtree(older, ignore_errors=True)
    wanted = size + int(_SPARE * shutil.disk_usage(copy.parent).total)
    others = _unused(copy.parent) if shutil.disk_usage(copy.parent).free < wanted else []
    while others and shutil.disk_usage(copy.parent).free < wanted:
        shutil.rmtree(others.pop(0), ignore_errors=True)
    if (free := shutil.disk_usage(copy.parent).free) < size:
        missing = f"no room for a copy of {copy.name}: {size:,} bytes are needed and {free:,} are free"
        raise OSError(errno.ENOSPC, missing, str(copy))


def _unused(folder: Path) -> list[Path]:
    """The folders of other copies that no task has used for a while, the least recently used first."""
    used = dict[Path, float]()
    for other in folder.parent.iterdir():
        with suppress(FileNotFoundError, NotADirectoryError):  # another task has removed it
            used[other] = (other / "lock").stat().st_mtime
    recent = time.time() - _RECENT_S
    return sorted((it for it, when in used.items() if it != folder and when < recent), key=used.__getitem__)


def _remove(cache: str) -> None:
    folder = Path(ray.get_runtime_context().get_temp_dir()) / _FOLDER / cache
    shutil.rmtree(folder, ignore_errors=True)
