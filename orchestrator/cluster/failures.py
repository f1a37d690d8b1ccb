"""What an exception that Ray brings says about an attempt."""

import torch
from ray.exceptions import (
    NodeDiedError,
    ObjectLostError,
    OutOfMemoryError,
    RayError,
    RayTaskError,
    TaskUnschedulableError,
    WorkerCrashedError,
)

from panolog.orchestrator.resources.pool import Failed
from panolog.orchestrator.run.records import Failure
from panolog.scene.errors import InputError, PanologError

_LOSSES: dict[type[RayError], str] = {
    WorkerCrashedError: "the worker process died: killed or crashed",
    NodeDiedError: "the worker's machine died or cannot be reached",
    TaskUnschedulableError: "the machine died before the worker began",
    ObjectLostError: "what the worker needed was lost with another machine",
}
CUT_OFF = Failed(_LOSSES[NodeDiedError], Failure.LOST)
_ALLOCATORS = ("DefaultCPUAllocator", "Insufficient memory")  # torch and OpenCV have no type for it


def failure_of(error: RayError, *, killed_for_memory: bool = False) -> Failed:
    """An attempt that ended with this error.

    Args: killed_for_memory, whether the kernel has ended a process on the worker's machine to free memory.
    """
    if isinstance(error, RayTaskError):
        return _raised(error)
    if isinstance(error, OutOfMemoryError):
        return Failed("out of memory: Ray ended the worker to save its machine", Failure.MEMORY, str(error))
    if isinstance(error, WorkerCrashedError) and killed_for_memory:
        return Failed("out of memory: the system killed the worker", Failure.MEMORY, str(error))
    for kind, reason in _LOSSES.items():
        if isinstance(error, kind):
            return Failed(reason, Failure.LOST, str(error))
    return Failed(f"Ray: {first_line(str(error))}", Failure.ERROR, str(error))


def first_line(text: str) -> str:
    """The first line of a text."""
    return (text.strip().splitlines() or [""])[0]


def _raised(error: RayTaskError) -> Failed:
    """The worker itself raised something."""
    cause = error.cause
    if isinstance(cause, RayError):  # it was asking another for something
        return failure_of(cause)
    if isinstance(cause, PanologError):
        return Failed(
            first_line(str(cause)), Failure.INPUT if isinstance(cause, InputError) else Failure.ERROR
        )
    if _out_of_memory(cause):
        return Failed(f"out of memory: {first_line(str(cause)) or 'on the CPU'}", Failure.MEMORY, str(error))
    return Failed(first_line(f"{type(cause).__name__}: {cause}"), Failure.ERROR, str(error))


def _out_of_memory(cause: Exception) -> bool:
    if isinstance(cause, MemoryError | torch.OutOfMemoryError):
        return True
    return any(name in str(cause) for name in _ALLOCATORS)
