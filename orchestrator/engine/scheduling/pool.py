"""What the driver needs of the place where tasks run, and what it is sent from there.

`cluster.pool.RayPool` runs tasks on the machines of a Ray cluster, or on this one; `driver.local_pool` in
plain processes of this one.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar

import torch

from panolog.orchestrator.engine.scheduling.large_messages import Large
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.scaling import NO_GROWTH, Growth
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import DeviceError, InputError, PanologError, RunError, first_line, out_of_memory
from panolog.scene.files import Locate, here
from panolog.workers.device_memory import CONTEXT
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import Source, TaskSpec, Value
from panolog.workers.tasks import CALIBRATE, TaskId

T = TypeVar("T")
NONE: Set[TaskId] = frozenset()
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Hello:
    """The first message of a task: where it runs."""

    node: str
    pid: int
    oom_kills: int = 0  # `machine.oom_kills` at that moment
    card: str = ""  # the UUID of its GPU, where another may have chosen that


@dataclass(frozen=True)
class Ended:
    """The last message of a task that ran to its end."""


@dataclass(frozen=True)
class Failed:
    """The last message of a task that did not."""

    reason: str  # one line
    kind: Failure = Failure.ERROR
    detail: str = ""  # the traceback of an unexpected error

    @staticmethod
    def of(error: BaseException, detail: str) -> "Failed":
        """The failure of a worker that has raised an error. Args: detail, its traceback."""
        text = first_line(str(error))
        if isinstance(error, InputError):
            return Failed(text, Failure.INPUT)
        if isinstance(error, torch.OutOfMemoryError) or out_of_memory(error):
            return Failed(f"out of memory: {text or 'on the CPU'}", Failure.MEMORY, detail)
        if isinstance(error, PanologError):
            return Failed(text)
        return Failed(first_line(f"{type(error).__name__}: {error}"), Failure.ERROR, detail)


Message = Hello | Event | Calibration | Usage | Large | Ended | Failed


class Sharing(Protocol):
    """How specs refer to values and files of this machine."""

    def put(self, value: T) -> Source[T]:
        """Shares a value with all tasks."""

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene and of the run. Raises OSError if one of them is gone."""


class Pool(Sharing, Protocol):
    """Where tasks run."""

    def nodes(self) -> tuple[Node, ...]:
        """The machines that are there now; the driver's own also if tasks cannot run on it."""

    def notices(self) -> Mapping[str, LeaveNotice]:
        """Which machines have announced that they leave, by Node.id."""

    def growth(self) -> Growth:
        """What an autoscaler could start, and does."""

    def request(self, wanted: Mapping[str, int]) -> None:
        """Requests so many machines more than there are, by the name of their group, and no others."""

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        """Runs a spec there."""

    def stop(self, task: TaskId) -> None:
        """Requests a last checkpoint and the end of a task that has said Hello."""

    def waiting(self, task: TaskId) -> bool:
        """Whether a task has no worker yet because other programs use the machine."""

    def cancel(self, task: TaskId) -> None:
        """Ends a task by force; nothing of it arrives any more."""

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        """The running tasks that have a message; returns after so many seconds if there are none.

        Args: ignored, tasks that do not count: their messages stay where they are.
        """

    def take(self, task: TaskId) -> Message:
        """The next message of a task that is ready. After Ended or Failed the pool has it no longer."""


def guarded(task: TaskId, events: Iterator[T]) -> Iterator[T]:
    """What a task yields. In its worker: an exception loses its cause between processes.

    Raises RunError in place of an InputError that need not be one, because it was caused by an OSError or is
    of the machine's device: both may be different elsewhere, or a moment later. A calibration finds out
    whether the device will do at all.
    """
    try:
        yield from events
    except InputError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, OSError):
            cause = cause.__cause__
        if cause is not None or (isinstance(error, DeviceError) and task != CALIBRATE):
            raise RunError(str(error)) from error
        raise


def on_its_card(spec: TaskSpec, where: Placement) -> TaskSpec:
    """A spec as the GPU of this process has room for it now; called in the worker, on a task's start.

    Other programs may have taken memory since the driver has seen the machine: that is `TaskSpec.taken`.
    Of a card that it shares, torch gets the task's part alone, and runs out of memory before others do.
    """
    if spec.device != "cuda" or not where.memory:
        return spec
    (free, total), part = torch.cuda.mem_get_info(), max(0, where.memory - CONTEXT)
    if where.gpus < 1:
        torch.cuda.set_per_process_memory_fraction(min(1.0, part / total))
    if (taken := max(0, part - free)) == 0:
        return spec
    _LOG.info("%s: others have taken %d MiB of its part of the GPU", spec.task, taken // 2**20)
    return replace(spec, taken=taken)


class InProcess:
    """`Sharing` with this process itself, on machines that are all there."""

    def put(self, value: T) -> Value[T]:
        return Value(value)

    def share_files(self, _scene: Iterable[Path], _run: Iterable[Path]) -> Locate:
        return here

    def growth(self) -> Growth:
        return NO_GROWTH

    def request(self, _wanted: Mapping[str, int]) -> None:
        """Nothing."""
