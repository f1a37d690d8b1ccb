"""Ray's autoscaler: which machines it can start, requests for some, and why they do not come.

A request is a task that takes a whole machine and does nothing, and that no machine which is there may run.
While it waits, the autoscaler starts a machine for it (docs/decisions/0013-requests-for-machines.md).
"""

import json
import logging
import os
import time
from collections.abc import Iterator, Mapping, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import ray
import requests
import yaml
from ray.autoscaler.v2.schema import ClusterStatus
from ray.autoscaler.v2.sdk import get_cluster_status
from ray.exceptions import RayError
from ray.experimental.internal_kv import _internal_kv_get

from panolog.orchestrator.engine.scheduling.scaling import NO_GROWTH, Group, Growth
from panolog.scene.errors import first_line

_LOG = logging.getLogger(__name__)
_INTERVAL_S = 2.0  # between two queries
_NAMESPACE = Path("/var/run/secrets/kubernetes.io/serviceaccount/namespace")
_PIN = 1e-3  # of a resource that a request takes so that only machines of its group serve it
_ACCELERATOR = "accelerator_type:"
_STANDARD = ("CPU", "GPU", "memory", "object_store_memory", "TPU")
_STATUS = b"__autoscaling_status"  # the key of the first autoscaler's report
_RECENT_S = 900.0  # for which a machine that could not be started counts as trouble


class Autoscaler:
    """The autoscaler of the cluster that this process has joined, if there is one."""

    def __init__(self, name: str) -> None:
        """Args: name, of the run's tasks."""
        self._name = f"{name}-machine"
        self._address: str = ray.get_runtime_context().gcs_address
        self.groups = groups_of(read_config(self._address))
        self._waiting: dict[str, list[Any]] = {}  # ray.ObjectRef of requests, by the name of the group
        self._growth, self._queried = Growth(self.groups), float("-inf")

    def growth(self) -> Growth:
        """What it could start, and what it reports, as of the last query."""
        if not self.groups:
            return NO_GROWTH
        if time.monotonic() - self._queried > _INTERVAL_S:
            self._queried = time.monotonic()
            with suppress(RayError, RuntimeError):  # the cluster's head does not answer for a moment
                self._growth = _read(self.groups, get_cluster_status(self._address))
        return self._growth

    def request(self, wanted: Mapping[str, int], there: Set[str]) -> None:
        """Makes requests for so many machines more than there are, by group, or takes requests back.

        Args: there, Node.id of all machines of the cluster.
        """
        for group in self.groups:
            waiting = self._waiting.setdefault(group.name, [])
            if waiting:
                _, waiting[:] = ray.wait(waiting, num_returns=len(waiting), timeout=0)
            count = wanted.get(group.name, 0)
            for surplus in waiting[count:]:
                ray.cancel(surplus)
            del waiting[count:]
            waiting += [self._task(group, there) for _ in range(count - len(waiting))]

    def close(self) -> None:
        """Takes all requests back."""
        self.request({}, frozenset())

    def _task(self, group: Group, there: Set[str]) -> Any:
        options: dict[str, Any] = {
            "name": self._name,
            "num_cpus": group.cpus,
            "num_gpus": group.gpus,
            "resources": dict.fromkeys(group.pins, _PIN),
            "max_retries": 0,
            "label_selector": {"ray.io/node-id": f"!in({','.join(sorted(there))})"} if there else None,
        }
        return ray.remote(_nothing).options(**options).remote()


def _nothing() -> None:
    """What a machine does that has come."""


def read_config(address: str) -> dict[str, Any]:
    """The autoscaler's configuration; empty if there is none, or none that can be seen from here.

    On Kubernetes it follows from the RayCluster, which the head's service account may read if KubeRay's
    autoscaling is on. Elsewhere it is the file with which the cluster's head was started on this machine.

    Args: address of the cluster's record (GCS).
    """
    name, namespace = os.environ.get("RAY_CLUSTER_NAME"), _NAMESPACE
    try:
        if name and namespace.exists():
            from ray.autoscaler._private.kuberay.autoscaling_config import (  # noqa: PLC0415  # for pods only
                AutoscalingConfigProducer,
            )

            producer: Any = AutoscalingConfigProducer(  # type: ignore[no-untyped-call]
                name, namespace.read_text().strip()
            )
            return dict(producer())
        for path in _config_files(address):
            content = yaml.safe_load(Path(path).expanduser().read_text())
            return content if isinstance(content, dict) else {}
    except (OSError, yaml.YAMLError, ValueError, requests.RequestException) as error:
        _LOG.info("the autoscaler's configuration cannot be read: %s", first_line(str(error)))
    return {}


def _config_files(address: str) -> Iterator[str]:
    """The file of the autoscaler that runs on this machine for a cluster."""
    option = "--autoscaling-config="
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            words = process.cmdline()
            if f"--gcs-address={address}" in words:
                yield from (word.removeprefix(option) for word in words if word.startswith(option))


def groups_of(config: Mapping[str, Any]) -> tuple[Group, ...]:
    """The machines that an autoscaler can start. Args: config, as `read_config`."""
    found = []
    most = config.get("max_workers")
    for name, given in (config.get("available_node_types") or {}).items():
        resources = given.get("resources") or {}
        cpus, gpus = int(resources.get("CPU", 0)), int(resources.get("GPU", 0))
        count = given.get("max_workers", most) or 0
        if name == config.get("head_node_type") or not count or not (cpus or gpus):
            continue
        pins = tuple(key for key in resources if key not in _STANDARD)
        accelerator = next((key[len(_ACCELERATOR) :] for key in pins if key.startswith(_ACCELERATOR)), "")
        labels = {key: f"{resources[key]:g}" for key in pins if not key.startswith(_ACCELERATOR)}
        node_config = given.get("node_config") or {}
        instance = node_config.get("InstanceType") or node_config.get("machineType") or ""
        market = (node_config.get("InstanceMarketOptions") or {}).get("MarketType")
        labels |= {"ray.io/market-type": market} if market else {}
        labels |= given.get("labels") or {}
        found.append(
            Group(
                name=name,
                most=min(count, most or count),
                cpus=cpus,
                gpus=gpus,
                accelerator=accelerator,
                memory=int(resources.get("memory", 0)),
                instance=instance,
                labels=tuple(sorted(labels.items())),
                pins=pins,
            )
        )
    return tuple(found)


def _read(groups: tuple[Group, ...], status: ClusterStatus) -> Growth:
    nodes, names = [*status.active_nodes, *status.idle_nodes], {group.name for group in groups}
    kinds = {node.node_id: node.ray_node_type_name for node in nodes if node.node_id}
    members = {id: kind for id, kind in kinds.items() if kind in names}
    return Growth(groups, members, trouble=_trouble(status))


def _trouble(status: ClusterStatus) -> str:
    """Why machines could not be started lately; "" if there is no reason."""
    recent = [one for one in status.failed_launches if (one.failed_ts_s or 0) > time.time() - _RECENT_S]
    if recent:
        last = max(recent, key=lambda one: one.failed_ts_s or 0)
        return first_line(last.details or f"a machine of {last.ray_node_type_name} could not be started")
    report = _internal_kv_get(_STATUS)  # the first autoscaler says it here only
    with suppress(ValueError, KeyError, TypeError, AttributeError):
        summary = json.loads(report or b"{}")["autoscaler_report"]["node_availability_summary"]
        for kind, one in summary["node_availabilities"].items():
            if why := one["unavailable_node_information"]:
                return first_line(f"{kind}: {why['category']}, {why['description']}")
    return ""
