"""Workers on Ray: tasks go in, messages come out.

Each task is a remote generator on a node that the driver names; what it yields arrives in order while it
runs.
"""

import os
import socket
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, WorkerCrashedError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from panolog.orchestrator.cluster.failures import CUT_OFF, failure_of
from panolog.orchestrator.cluster.files import FileSharing, NodeFiles, Parcel, work_with
from panolog.orchestrator.cluster.nodes import RayNodes, on_node
from panolog.orchestrator.cluster.tensors import send_as_arrays
from panolog.orchestrator.resources.machine import oom_kills
from panolog.orchestrator.resources.messages import Ended, Failed, Hello, Message
from panolog.orchestrator.resources.nodes import Node, Place
from panolog.orchestrator.resources.pool import Work
from panolog.orchestrator.run.records import LOST
from panolog.renderer.process import prepare
from panolog.scene.files import Locate, here
from panolog.workers import stopping
from panolog.workers.events import Event

_UNREAD = 8  # events a worker may be ahead of the driver, so that checkpoints do not pile up in memory


@dataclass
class _Task:
    place: Place
    messages: Any  # ray.ObjectRefGenerator
    hello: Hello | None = None


class RayPool:
    """The tasks that run now. Made by `connect`."""

    def __init__(self, sharing: FileSharing | None) -> None:
        self._sharing = sharing  # None where all tasks run on this machine
        self._nodes = RayNodes()
        self._running: dict[str, _Task] = {}

    def nodes(self) -> tuple[Node, ...]:
        """The machines that are there now."""
        return self._nodes.alive()

    def put(self, value: object) -> Any:
        """Shares a value with all tasks: hand the result to `start` in its place."""
        ref = ray.put(value)
        return ref if self._sharing is None else Parcel(ref)

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene, and files that the run has made.

        Raises OSError if one of them is gone.
        """
        return here if self._sharing is None else self._sharing.share_files(scene, run)

    def start(self, name: str, place: Place, work: Work, fields: dict[str, Any]) -> None:
        """Runs `work(**fields)` there; waits until others that use the cluster have made room."""
        remote = ray.remote(_run).options(
            num_cpus=place.cpus,
            num_gpus=place.gpus,
            num_returns="streaming",
            max_retries=0,
            scheduling_strategy=NodeAffinitySchedulingStrategy(place.node, soft=False),
            runtime_env=_environment(place),
            _generator_backpressure_num_objects=_UNREAD,
        )
        self._running[name] = _Task(place, remote.remote(work, place.threads, **fields))

    def stop(self, name: str) -> None:
        """Asks a task that has said Hello for a last checkpoint and its end."""
        task = self._running[name]
        if task.hello is None:
            return
        if task.place.node == self._nodes.home:
            stopping.request(task.hello.pid)
        else:
            on_node(stopping.request, task.place.node).remote(task.hello.pid)

    def wait(self, seconds: float) -> list[tuple[str, Message]]:
        """The next message of every task that has one; waits at most `seconds` for the first."""
        if not self._running:
            time.sleep(seconds)  # until a machine joins, of which Ray does not tell
            return []
        generators = [task.messages for task in self._running.values()]
        ray.wait(generators, num_returns=1, timeout=seconds)
        some, _ = ray.wait(generators, num_returns=len(generators), timeout=0)
        ready = set(map(id, some))
        names = [name for name, task in self._running.items() if id(task.messages) in ready]
        return [(name, self._take(name)) for name in names] + self._cut_off(but=set(names))

    def _cut_off(self, but: set[str]) -> list[tuple[str, Message]]:
        """Fails the tasks of machines that are gone: Ray itself waits for what may still come."""
        tasks = self._running.items()
        gone = [name for name, task in tasks if name not in but and self._nodes.gone(task.place.node)]
        for name in gone:
            del self._running[name]
        return [(name, CUT_OFF) for name in gone]

    def _take(self, name: str) -> Message:
        """The next message of a task, which is there."""
        task = self._running[name]
        try:
            message: Message = ray.get(next(task.messages))
        except StopIteration:
            message = Ended()
        except RayError as error:
            message = failure_of(error, killed_for_memory=self._killed_for_memory(task, error))
        if isinstance(message, Hello):
            task.hello = message
        elif isinstance(message, Ended | Failed):
            del self._running[name]
        if isinstance(message, Failed) and message.kind == LOST:
            self._nodes.look()
        return message

    def _killed_for_memory(self, task: _Task, error: RayError) -> bool:
        """Whether the kernel has killed somebody on its machine, for want of memory, since it began."""
        if not isinstance(error, WorkerCrashedError) or task.hello is None:
            return False
        kills = self._nodes.oom_kills(task.place.node)
        return kills is not None and kills > task.hello.oom_kills


def _environment(place: Place) -> dict[str, Any] | None:
    """Tells CUDA which GPU to use where the node has unequal ones: Ray would take any."""
    if not place.uuid:
        return None
    names = {"RAY_EXPERIMENTAL_NOSET_CUDA_VISIBLE_DEVICES": "1", "CUDA_VISIBLE_DEVICES": place.uuid}
    return {"env_vars": names}


def _run(work: Work, threads: int, **fields: Any) -> Iterator[Hello | Event]:
    """What runs on the worker."""
    os.environ["OMP_NUM_THREADS"] = str(threads)
    prepare(threads)
    send_as_arrays()
    stopping.listen()
    yield Hello(socket.gethostname(), os.getpid(), oom_kills())
    files = fields["locate"]
    yield from work_with(files, work, fields) if isinstance(files, NodeFiles) else work(**fields)
