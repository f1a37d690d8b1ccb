"""What other programs have of a cluster's machines: tasks may wait for them, and a run pays for the rest."""

import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import ray
from ray._private.state import available_resources_per_node
from ray.util.state import get_task, list_actors, list_tasks
from ray.util.state.exception import RayStateApiException

from panolog.orchestrator.runs.machines.nodes import Node

_LOOKS = 3  # in all of which something is others': Ray frees what a task of ours had some time after its end
_STEPS = 20  # shares of a machine are counted in such parts
_TIMEOUT_S = 5  # in which the dashboard must answer a query
_PAUSE_S = 60.0  # without queries after one that has failed
_WAITS = ("PENDING_ARGS_AVAIL", "PENDING_NODE_ASSIGNMENT")


class Places:
    """Queries about tasks of this driver, as Ray's dashboard lists them."""

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


class Others:
    """The last looks at each machine."""

    def __init__(self) -> None:
        self._taken: dict[str, deque[float]] = {}  # parts of machines, by Node.id

    def look(self, nodes: Iterable[Node], held: Mapping[str, float]) -> None:
        """Takes note of what is taken now.

        Args: held, GPUs, or cores of a machine without, that tasks of this run have, by Node.id.
        """
        free = available_resources_per_node()  # type: ignore[no-untyped-call]
        for node in nodes:
            if not (total := float(len(node.gpus) or node.cpus)):
                continue
            left = free.get(node.id, {}).get("GPU" if node.gpus else "CPU", 0.0)
            taken = (total - left - held.get(node.id, 0.0)) / total
            looks = self._taken.setdefault(node.id, deque([0.0], _LOOKS))
            looks.append(min(1.0, max(0.0, taken)))

    def share(self, id: str) -> float:
        """The part of a machine that no other program has."""
        return 1.0 - round(min(self._taken.get(id, (0.0,))) * _STEPS) / _STEPS
