"""What the driver needs of the place where tasks run, and what it is sent from there.

`cluster.pool.RayPool` runs tasks on the machines of a Ray cluster, or on this one; `driver.local_pool` in
plain processes of this one.
"""

from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import torch

from panolog.orchestrator.engine.scheduling.delivery import Large
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.scaling import NO_GROWTH, Growth
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import DeviceError, InputError, PanologError, RunError
from panolog.scene.files import Locate, here
from panolog.workers.events import Calibration, Event
from panolog.workers.specs import Source, TaskSpec, Value
from panolog.workers.tasks import CALIBRATE, TaskId

T = TypeVar("T")
NONE: Set[TaskId] = frozenset()
_ALLOCATORS = ("DefaultCPUAllocator", "Insufficient memory")  # torch and OpenCV raise no type of their own


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
        """That of a worker that has raised an error. Args: detail, its traceback."""
        if isinstance(error, PanologError):
            kind = Failure.INPUT if isinstance(error, InputError) else Failure.ERROR
            return Failed(first_line(str(error)), kind)
        untyped = any(allocator in str(error) for allocator in _ALLOCATORS)
        if untyped or isinstance(error, MemoryError | torch.OutOfMemoryError):
            return Failed(f"out of memory: {first_line(str(error)) or 'on the CPU'}", Failure.MEMORY, detail)
        return Failed(first_line(f"{type(error).__name__}: {error}"), Failure.ERROR, detail)


Message = Hello | Event | Calibration | Usage | Large | Ended | Failed


class Sharing(Protocol):
    """How specs refer to values and files of this machine."""

    def put(self, value: T) -> Source[T]:
        """Shares a value with all tasks."""

    def share_files(self, scene: Iterable[Path], run: Iterable[Path]) -> Locate:
        """How a task finds files of the scene, and files that the run has made."""


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

    def ready(self, seconds: float, but: Set[TaskId] = NONE) -> list[TaskId]:
        """The running tasks that have a message; returns after so many seconds if there are none.

        Args: but, tasks that do not count: their messages stay where they are.
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


def first_line(text: str) -> str:
    """The first line of a text."""
    return (text.strip().splitlines() or [""])[0]


class InProcess:
    """`Sharing` with this process itself, on machines that are all there."""

    def put(self, value: T) -> Value[T]:
        """The value."""
        return Value(value)

    def share_files(self, _scene: Iterable[Path], _run: Iterable[Path]) -> Locate:
        """Every file is where it is."""
        return here

    def growth(self) -> Growth:
        """No machine can be started."""
        return NO_GROWTH

    def request(self, _wanted: Mapping[str, int]) -> None:
        """Nothing."""
