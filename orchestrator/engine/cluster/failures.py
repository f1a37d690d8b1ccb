"""What an exception of Ray means for an attempt, and for the run."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from ray.exceptions import (
    GetTimeoutError,
    NodeDiedError,
    ObjectLostError,
    OutOfMemoryError,
    RayError,
    RayTaskError,
    TaskUnschedulableError,
    WorkerCrashedError,
)

from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs.machines.history import MACHINE_DIED, MACHINE_GONE
from panolog.orchestrator.runs.records import Failure
from panolog.scene.errors import ClusterLostError, first_line

P = ParamSpec("P")
T = TypeVar("T")

_LOSSES: dict[type[RayError], str] = {
    WorkerCrashedError: "the worker process died: killed or crashed",
    NodeDiedError: MACHINE_DIED,
    TaskUnschedulableError: MACHINE_GONE,
    ObjectLostError: "what the worker needed was lost with another machine",
    GetTimeoutError: "a message of the worker did not arrive",
}
CUT_OFF = Failed(_LOSSES[NodeDiedError], Failure.LOST)


def failure_of(error: RayError, *, killed_for_memory: bool = False) -> Failed:
    """An attempt that ended with this error.

    Args: killed_for_memory, whether the kernel has ended a process on the worker's machine to free memory.
    """
    if isinstance(error, RayTaskError):
        cause = error.cause
        if isinstance(cause, RayError):  # raised by a call of the worker to Ray
            return failure_of(cause)
        return Failed.of(cause, str(error))
    if isinstance(error, OutOfMemoryError):
        return Failed("out of memory: Ray ended the worker to save its machine", Failure.MEMORY, str(error))
    if isinstance(error, WorkerCrashedError) and killed_for_memory:
        return Failed("out of memory: the system killed the worker", Failure.MEMORY, str(error))
    for kind, reason in _LOSSES.items():
        if isinstance(error, kind):
            return Failed(reason, Failure.LOST, str(error))
    return Failed(f"Ray: {first_line(str(error))}", Failure.ERROR, str(error))


def reported(method: Callable[P, T]) -> Callable[P, T]:
    """A method that raises ClusterLostError for what Ray itself raises, with its first line."""

    @wraps(method)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return method(*args, **kwargs)
        except RayError as error:
            raise ClusterLostError(f"Ray: {first_line(str(error)) or type(error).__name__}") from error

    return wrapper
