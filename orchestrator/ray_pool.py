"""Workers on Ray: tasks go in, messages come out.

Each task is a remote generator; what it yields arrives in order while it runs. The scene and the Stage I
model are put into the object store once and shared by all tasks.
"""

import os
import socket
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import (
    NodeDiedError,
    OutOfMemoryError,
    RayError,
    RayTaskError,
    WorkerCrashedError,
)

from panolog.orchestrator.messages import ERROR, INPUT, LOST, MEMORY, Ended, Failed, Hello, Message
from panolog.orchestrator.node_files import FileSharing, NodeFiles, Parcel, work_with
from panolog.orchestrator.policy import Machine, Share
from panolog.renderer.process import prepare
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import Locate, here
from panolog.workers.events import Event

_UNREAD = 8  # events a worker may be ahead of the driver, so that checkpoints do not pile up in memory

_DEATHS: dict[type[RayError], tuple[str, str]] = {
    WorkerCrashedError: (LOST, "the worker process died: killed, out of memory, or crashed"),
    NodeDiedError: (LOST, "the worker's machine died or cannot be reached"),
    OutOfMemoryError: (MEMORY, "the worker's machine ran out of memory and Ray ended the worker"),
}

Work = Callable[..., Iterator[Event]]


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
        reason = first_line(str(cause) if known else f"{type(cause).__name__}: {cause}")
        kind = INPUT if isinstance(cause, InputError) else ERROR
        return Failed(reason, kind, "" if known else error.traceback_str)
    except RayError as error:
        kind, reason = _DEATHS.get(type(error)) or (ERROR, f"Ray: {first_line(str(error))}")
        return Failed(reason, kind, str(error))
    return message


def first_line(text: str) -> str:
    """The first line of a text."""
    return (text.strip().splitlines() or [""])[0]
