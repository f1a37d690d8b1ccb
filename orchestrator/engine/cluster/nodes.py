"""The machines of a Ray cluster, each described by itself when it is first seen."""

import re
import time
from typing import Any

import ray
from ray._private.state import state
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.runs.machines.gpus import describe_gpus
from panolog.orchestrator.runs.machines.machine import (
    instance_type,
    memory,
    memory_of,
    memory_total,
    oom_kills,
    share,
)
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from panolog.orchestrator.runs.records import Leaving
from panolog.scene.errors import ClusterLostError

_OWN = re.compile("CPU|GPU|memory|object_store_memory|node:|accelerator_type:")  # resources that Ray names
_INTERVAL_S = 2.0  # between two queries of the machines
_TIMEOUT_S = 30.0  # in which the machines that are there at the start must have described themselves


class RayNodes:
    """The machines that are there now. A machine that joins counts once it has described itself."""

    def __init__(self, name: str) -> None:
        """Args: name, of the run's tasks."""
        self._name = name
        self.home: str = ray.get_runtime_context().get_node_id()
        self._known: dict[str, Node] = {}
        self._pending: dict[str, tuple[dict[str, Any], Any]] = {}
        self.ids: frozenset[str] = frozenset()  # Node.id of those that are alive, as of the last query
        self.queried = float("-inf")  # time.monotonic() of the last query
        self._draining: dict[str, int] = {}  # deadlines in milliseconds since the epoch, 0 = none
        self._query()
        answers = [answer for _, answer in self._pending.values()]
        if answers:
            ray.wait(answers, num_returns=len(answers), timeout=_TIMEOUT_S)

    def alive(self) -> tuple[Node, ...]:
        """The machines that tasks can run on, and the driver's own."""
        if time.monotonic() - self.queried > _INTERVAL_S:
            self._query()
        self._collect()
        nodes = (self._known[id] for id in sorted(self.ids) if id in self._known)
        return tuple(node for node in nodes if node.cpus or node.gpus or node.id == self.home)

    def draining(self) -> dict[str, LeaveNotice]:
        """The machines on which Ray starts nothing more, by Node.id, as of the last query."""
        now = time.time()
        return {
            id: LeaveNotice(Leaving.DRAIN, max(0.0, deadline / 1000 - now) if deadline else None)
            for id, deadline in self._draining.items()
        }

    def gone(self, id: str) -> bool:
        """Whether the cluster has given a machine up."""
        if time.monotonic() - self.queried > _INTERVAL_S:
            self._query()
        return id not in self.ids

    @property
    def joining(self) -> int:
        """How many machines that are alive have not described themselves yet, as of the last query."""
        return len(self.ids & self._pending.keys())

    def refresh(self) -> None:
        """Queries Ray anew the next time: a machine may be gone."""
        self.queried = float("-inf")

    def oom_kills(self, id: str) -> int | None:
        """`machine.oom_kills` of a machine now; None if that does not answer."""
        if id == self.home:
            return oom_kills()
        try:
            kills: int | None = ray.get(on_node(oom_kills, id, max_retries=0).remote(), timeout=_TIMEOUT_S)
        except RayError:
            return None
        return kills

    def _query(self) -> None:
        # If the head does not answer, Ray itself ends this process (gcs_rpc_server_reconnect_timeout_s).
        self.queried = time.monotonic()
        raw = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}  # type: ignore[no-untyped-call]
        self.ids = frozenset(raw)
        # Ray's own libraries use this; its public list of nodes does not say it without a dashboard.
        self._draining = state.get_draining_nodes()
        if self.home not in raw:
            raise ClusterLostError("Ray has ended on the driver's machine: its raylet is lost")
        for id in self.ids - self._known.keys() - self._pending.keys():
            gpus = int(raw[id]["Resources"].get("GPU", 0))
            if id == self.home:  # asking takes a process of its own elsewhere
                self._know(raw[id], *describe(gpus, self._name))
            else:
                described = on_node(describe, id, max_retries=0).remote(gpus, self._name)
                self._pending[id] = raw[id], described

    def _collect(self) -> None:
        for id, (raw, answer) in list(self._pending.items()):
            if not ray.wait([answer], timeout=0)[0]:
                continue
            del self._pending[id]
            try:
                self._know(raw, *ray.get(answer))
            except RayError:  # gone again: if it comes back, it is queried again
                self.queried = float("-inf")

    def _know(self, raw: dict[str, Any], free: int, gpus: tuple[Gpu, ...], instance: str) -> None:
        id, host = raw["NodeID"], raw["NodeManagerHostname"]
        cpus = int(raw["Resources"].get("CPU", 0))
        part = share() if id == self.home else 1.0
        self._known[id] = Node(id, host, cpus, free, gpus, instance, _labels(raw), share=part)


def _labels(raw: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """What a price list may know a machine by: Ray's labels, and resources that are not Ray's own."""
    own = {name: f"{value:g}" for name, value in raw["Resources"].items() if _OWN.match(name) is None}
    return tuple(sorted({**own, **raw.get("Labels", {})}.items()))


def describe(gpus: int, name: str) -> tuple[int, tuple[Gpu, ...], str]:
    """Bytes of memory that tasks may use on this machine, the GPUs that Ray has found on it, and its type.

    What workers of the run hold counts as free: after a kill, its next driver may find those of the last.
    """
    free = min(memory_total(), memory() + memory_of(f"ray::{name}"))
    return free, describe_gpus(gpus), instance_type()


def on_node(what: Any, id: str, **options: Any) -> Any:
    """A function or an actor as a remote one that takes no resources and runs on one machine only."""
    here = NodeAffinitySchedulingStrategy(id, soft=False)
    return ray.remote(what).options(num_cpus=0, scheduling_strategy=here, **options)
