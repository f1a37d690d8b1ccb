"""Whether a task without a worker waits for other programs on its machine, as Ray's dashboard lists it."""

import time
from typing import Any

import ray
from ray.util.state import get_task, list_actors, list_tasks
from ray.util.state.exception import RayStateApiException

_TIMEOUT_S = 5  # in which the dashboard must answer a query
_PAUSE_S = 60.0  # without queries after one that has failed
_WAITS = ("PENDING_ARGS_AVAIL", "PENDING_NODE_ASSIGNMENT")


class Places:
    """Queries about tasks of this driver."""

    def __init__(self) -> None:
        context = ray.get_runtime_context()
        self._address: str = context.gcs_address
        self._job: str = context.get_job_id()
        self._failed = float("-inf")  # time.monotonic() of the last query without an answer

    def waits(self, task: str, node: str) -> bool:
        """Whether Ray has not placed a task yet, because others hold resources of the node.

        Ray also lists a task as waiting while its worker process starts: without other users that is the
        cause. False where no dashboard answers: then the deadline holds.

        Args: task, node, Ray's ids.
        """
        if time.monotonic() - self._failed < _PAUSE_S:
            return False
        try:
            found = get_task(task, self._address, timeout=_TIMEOUT_S)
            return getattr(found, "state", None) in _WAITS and self._shared(node)
        except (RayStateApiException, OSError):
            self._failed = time.monotonic()
            return False

    def _shared(self, node: str) -> bool:
        """Whether tasks or actors of other programs hold resources of a node."""
        there = [("node_id", "=", node), ("job_id", "!=", self._job)]
        options: dict[str, Any] = {"address": self._address, "detail": True, "timeout": _TIMEOUT_S}
        tasks: list[Any] = list_tasks(filters=[*there, ("state", "=", "RUNNING")], **options)
        actors: list[Any] = list_actors(filters=[*there, ("state", "=", "ALIVE")], **options)
        return any(user.required_resources for user in [*tasks, *actors])
