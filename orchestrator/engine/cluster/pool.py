"""Workers on Ray: each task is a remote generator on a node that the driver names."""

import os
import socket
import time
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import ray
import torch
from numpy.typing import NDArray
from ray.exceptions import RayError, RayTaskError, WorkerCrashedError
from ray.util import register_serializer
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from panolog.orchestrator.engine.cluster.agents import Agents
from panolog.orchestrator.engine.cluster.autoscaler import Autoscaler
from panolog.orchestrator.engine.cluster.failures import CUT_OFF, failure_of, reported
from panolog.orchestrator.engine.cluster.nodes import RayNodes
from panolog.orchestrator.engine.cluster.places import Others, Places
from panolog.orchestrator.engine.cluster.remote_files import FileSharing, RayValue, run_remotely
from panolog.orchestrator.engine.scheduling.large_messages import Large, announced
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.pool import (
    NONE,
    Ended,
    Failed,
    Hello,
    Message,
    guarded,
    on_its_card,
)
from panolog.orchestrator.engine.scheduling.scaling import NO_GROWTH, Growth
from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.info import own_code
from panolog.orchestrator.runs.machines.gpus import gpus_to_share
from panolog.orchestrator.runs.machines.machine import oom_kills
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.machines.usage import Usage, with_usage
from panolog.orchestrator.runs.records import Failure
from panolog.renderer.process import prepare
from panolog.scene.errors import RunError
from panolog.scene.files import Locate, here
from panolog.scene.stores.cache import variables
from panolog.workers import stopping
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId

_UNREAD = 8  # messages that a worker may be ahead of the driver, at most one of them large
_HERE_S = 60.0  # in which a message that is ready must be read
T = TypeVar("T")


@dataclass
class _Task:
    placement: Placement
    messages: Any  # ray.ObjectRefGenerator
    hello: Hello | None = None
    cut_off: bool = False  # its machine is gone


class RayPool:
    """The tasks that run now. Made by `connect`. Every method raises RunError if Ray itself fails."""

    def __init__(self, sharing: FileSharing | None, run: str) -> None:
        """Args: sharing, None where all tasks run on this machine; run, a name that all its drivers have."""
        self._sharing = sharing
        self._name = f"panolog-{run}"  # of its tasks, and in the titles of their processes
        self._places = None if sharing is None else Places()
        self._others = None if sharing is None else Others()
        self._nodes = RayNodes(self._name)
        self._agents = Agents(self._nodes.home)
        self._autoscaler = None if sharing is None else Autoscaler(self._name)
        self._running: dict[TaskId, _Task] = {}
        self._looked = 0.0  # RayNodes.queried at the last look at what others have

    @reported
    def nodes(self) -> tuple[Node, ...]:
        """The machines that are there now, but those on which nothing runs and nothing is to start."""
        own = {self._nodes.home}
        unused = self._nodes.draining().keys() - self._busy() - own  # the autoscaler removes them
        nodes = tuple(node for node in self._nodes.alive() if node.id not in unused)
        if self._others is None:
            return nodes
        if self._nodes.queried != self._looked:
            self._looked = self._nodes.queried
            self._others.look(nodes, self._held())
        shares = map(self._others.share, (node.id for node in nodes))
        pairs = zip(nodes, shares, strict=True)
        return tuple(node if share == node.share else replace(node, share=share) for node, share in pairs)

    def _held(self) -> dict[str, float]:
        """GPUs, or cores of tasks without, that tasks have, by Node.id."""
        held = defaultdict[str, float](float)
        for where in (running.placement for running in self._running.values()):
            held[where.node] += where.gpus or where.cpus
        return held

    @reported
    def notices(self) -> dict[str, LeaveNotice]:
        draining = self._nodes.draining()
        self._agents.review(self._nodes.ids, draining, self._busy())
        return self._agents.notices() | draining

    def _busy(self) -> set[str]:
        return {running.placement.node for running in self._running.values()}

    @reported
    def growth(self) -> Growth:
        if self._autoscaler is None:
            return NO_GROWTH
        growth, alive = self._autoscaler.growth(), self._nodes.ids
        members = {id: group for id, group in growth.members.items() if id in alive}
        return replace(growth, members=members, joining=self._nodes.joining)

    @reported
    def request(self, wanted: Mapping[str, int]) -> None:
        if self._autoscaler is not None:
            self._autoscaler.request(wanted, self._nodes.ids)

    @reported
    def put(self, value: T) -> RayValue[T]:
        """Shares a value with all tasks. Ray raises where neither memory nor disk has room for it."""
        return RayValue(ray.put(value), self._nodes.home)

    @reported
    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        return here if self._sharing is None else self._sharing.share_files(scene, run)

    @reported
    def start(self, placement: Placement, spec: TaskSpec) -> None:
        """Runs a spec there; waits until others that use the cluster have made room."""
        # The process of a task on a GPU ends with it, so that the next one gets neither cached memory nor a
        # context that an error has broken. On the CPU there is neither, and imports take seconds.
        function = ray.remote(max_calls=1)(_run) if placement.gpus else ray.remote(_run)
        remote = function.options(
            name=self._name,
            num_cpus=placement.cpus,
            num_gpus=placement.gpus,
            num_returns="streaming",
            max_retries=0,
            scheduling_strategy=NodeAffinitySchedulingStrategy(placement.node, soft=False),
            runtime_env=_environment(placement, pin=placement.pinned or self._sharing is None),
            _generator_backpressure_num_objects=_UNREAD,
        )
        self._agents.start(placement.node)
        self._running[spec.task] = _Task(placement, remote.remote(spec, placement, own_code()))

    @reported
    def stop(self, task: TaskId) -> None:
        running = self._running[task]
        if running.hello is not None:
            self._agents.stop(running.placement.node, running.hello.pid)

    def waiting(self, task: TaskId) -> bool:
        """Whether a task has no worker yet because others use the machine.

        A whole GPU also waits for tasks of this run that Ray has put on parts of all GPUs.
        """
        running, others = self._running[task], self._running.values()
        where = running.placement
        if where.gpus == 1 and any(
            other.hello and other.placement.node == where.node and 0 < other.placement.gpus < 1
            for other in others
        ):
            return True
        if self._places is None:  # Ray is for this run alone
            return False
        return self._places.waits(running.messages.completed().task_id().hex(), where.node)

    @reported
    def cancel(self, task: TaskId) -> None:
        """Ends a task by force; nothing of it arrives any more.

        The machine's raylet kills the process within some seconds, also one that is stopped, and gives its
        resources to the next task.
        """
        ray.cancel(self._running[task].messages, force=True)
        self._forget(task)

    @reported
    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        """The tasks that have a message, which is here; waits at most `seconds` for the first.

        Args: ignored, tasks that do not count: Ray fetches the messages of the others, so theirs stay remote.
        """
        if self._sharing is not None:
            self._sharing.review()
        others = {task: running for task, running in self._running.items() if task not in ignored}
        if not others:
            time.sleep(seconds)  # until a machine joins, which Ray does not report
            return []
        generators = [running.messages for running in others.values()]
        ray.wait(generators, num_returns=1, timeout=seconds)
        some, _ = ray.wait(generators, num_returns=len(generators), timeout=0)
        ready = set(map(id, some))
        for running in others.values():  # Ray itself waits for what may still come
            gone = id(running.messages) not in ready and self._nodes.gone(running.placement.node)
            running.cut_off = running.cut_off or gone
        return [task for task, running in others.items() if running.cut_off or id(running.messages) in ready]

    @reported
    def take(self, task: TaskId) -> Message:
        running = self._running[task]
        if running.cut_off:
            del self._running[task]
            return CUT_OFF
        try:
            message: Message = ray.get(next(running.messages), timeout=_HERE_S)
        except StopIteration:
            message = Ended()
            del self._running[task]
        except RayTaskError as error:
            message = failure_of(error)
            self._forget(task)  # it has ended: a cancellation could kill the next task of its worker
        except RayError as error:
            message = failure_of(error, killed_for_memory=self._killed_for_memory(running, error))
            self.cancel(task)  # where only a message is lost, the worker is still there
        if isinstance(message, Hello):
            running.hello = message
        if isinstance(message, Failed) and message.kind == Failure.LOST:
            self._nodes.refresh()
        return message

    def close(self) -> None:
        """Ends what the pool has on its machines besides tasks, and its requests for others."""
        if self._autoscaler is not None:
            with suppress(RayError):  # Ray itself has failed, and its requests with it
                self._autoscaler.close()
        self._agents.close()

    def _forget(self, task: TaskId) -> None:
        del self._running[task]
        if self._sharing is not None:  # what the task has waited for may be a file
            self._sharing.suspect()

    def _killed_for_memory(self, task: _Task, error: RayError) -> bool:
        """Whether the kernel has killed a process of its machine, for want of memory, since it began."""
        if not isinstance(error, WorkerCrashedError) or task.hello is None:
            return False
        kills = self._nodes.oom_kills(task.placement.node)
        return kills is not None and kills > task.hello.oom_kills


def _environment(placement: Placement, *, pin: bool) -> dict[str, Any] | None:
    """The log level, the cache of object stores, and if `pin` the GPU for CUDA: Ray would take any."""
    names = log.environment() | variables(os.environ)
    if pin and placement.uuid:
        names |= {"RAY_EXPERIMENTAL_NOSET_CUDA_VISIBLE_DEVICES": "1", "CUDA_VISIBLE_DEVICES": placement.uuid}
    return {"env_vars": names} if names else None


def imported() -> None:
    """Does nothing: a worker that has run it has imported what tasks need, which takes seconds."""


def _run(
    spec: TaskSpec, where: Placement, code: str
) -> Iterator[Hello | Event | Calibration | Usage | Large]:
    """What runs on the worker. Args: code, the driver's."""
    os.environ["OMP_NUM_THREADS"] = str(where.threads)
    log.configure()
    prepare(where.threads)
    _send_tensors_as_arrays()
    stopping.listen()
    cards = gpus_to_share() if spec.device == "cuda" else ()
    yield Hello(socket.gethostname(), os.getpid(), oom_kills(), cards[0] if len(cards) == 1 else "")
    yield from announced(with_usage(guarded(spec.task, _with_code(code, spec, where))), _UNREAD)


def _with_code(code: str, spec: TaskSpec, where: Placement) -> Iterator[Event | Calibration | Usage]:
    """What a spec yields. Raises RunError if the code is not the driver's: parts of a model would differ."""
    if (own := own_code()) != code:
        raise RunError(
            f"{socket.gethostname()} has another PanoLOG than the driver (sources {own}, not {code}):"
            " install the same version on all machines"
        )
    yield from run_remotely(on_its_card(spec, where))


def _send_tensors_as_arrays() -> None:
    """Bytes of tensors pass from this process's memory into the object store.

    By default torch pickles the bytes of each tensor, and Ray that pickle: with a checkpoint of a million
    Gaussians these are one and a half gigabytes more.
    """
    register_serializer(torch.Tensor, serializer=_array, deserializer=_tensor)


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    return tensor.detach().cpu().contiguous().numpy()


def _tensor(array: NDArray[Any]) -> torch.Tensor:
    """Shares the object store's memory: it is there to be read."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of what cannot be written
        return torch.from_numpy(array)
