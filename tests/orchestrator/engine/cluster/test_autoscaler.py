"""Ray's own autoscaler: what it can start, and machines that come and go."""

import json
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
import yaml
from ray.autoscaler._private.kuberay.autoscaling_config import _derive_autoscaling_config_from_ray_cr
from ray.autoscaler.v2.schema import ClusterStatus, LaunchRequest

from panolog.orchestrator.engine.cluster import autoscaler
from panolog.orchestrator.engine.cluster.autoscaler import groups_of, read_config
from panolog.orchestrator.engine.cluster.connection import connect
from panolog.orchestrator.engine.scheduling.placement import able
from panolog.orchestrator.engine.scheduling.scaling import Group, Growth
from panolog.orchestrator.runs.machines.nodes import Node
from tests.orchestrator.engine.cluster.autoscaled import autoscaled

DEPLOY = Path(__file__).parents[4] / "deploy"


def test_the_groups_of_aws_are_its_workers() -> None:
    config = yaml.safe_load((DEPLOY / "aws.yaml").read_text())
    for name, kind in config["available_node_types"].items():  # as `ray up` fills it in
        gpus = {"GPU": 1, "accelerator_type:L40S": 1} if name != "head" else {}
        kind["resources"] = {"CPU": 8, "memory": 2**36, **gpus, **kind["resources"]}
    groups = groups_of(config)
    assert [group.name for group in groups] == ["worker"]
    (worker,) = groups
    assert (worker.most, worker.cpus, worker.gpus, worker.accelerator) == (4, 8, 1, "L40S")
    assert worker.pins == ("accelerator_type:L40S",)
    assert worker.instance == "g6e.2xlarge"
    assert ("ray.io/market-type", "spot") in worker.labels


def test_the_groups_of_kubernetes_are_as_kuberay_understands_our_file() -> None:
    job = next(yaml.safe_load_all((DEPLOY / "kuberay.yaml").read_text()))
    spec = job["spec"]["rayClusterSpec"]
    assert spec["enableInTreeAutoscaling"]
    made = {"metadata": {"name": "panolog", "namespace": "default"}, "spec": spec}
    config = _derive_autoscaling_config_from_ray_cr(made)
    assert config["idle_timeout_minutes"] == 1
    assert groups_of(config) == (Group("gpu", 4, 6, 1, memory=48 * 2**30),)
    assert config["available_node_types"]["gpu"]["min_workers"] == 0


def test_a_group_has_no_more_machines_than_the_cluster_and_without_configuration_there_is_none() -> None:
    kind = {"resources": {"CPU": 4}, "max_workers": 10}
    config = {"max_workers": 3, "available_node_types": {"a": kind}, "head_node_type": "head"}
    assert groups_of(config)[0].most == 3
    empty: list[dict[str, object]] = [{}, {"available_node_types": None}, {"available_node_types": {"a": {}}}]
    for nothing in empty:
        assert groups_of(nothing) == ()
    assert read_config("127.0.0.1:1") == {}


def test_trouble_is_what_could_not_be_started_lately(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1_000_000
    monkeypatch.setattr(time, "time", lambda: now)
    monkeypatch.setattr(autoscaler, "_internal_kv_get", lambda _: None)

    def failed(ago: int, why: str) -> LaunchRequest:
        return LaunchRequest("", "gpu", 1, LaunchRequest.Status.FAILED, now - ago, now - ago, why)

    status = ClusterStatus(failed_launches=[failed(60, "no capacity\nin detail"), failed(90, "quota")])
    assert autoscaler._trouble(status) == "no capacity"
    assert autoscaler._trouble(ClusterStatus(failed_launches=[failed(2000, "no capacity")])) == ""
    nameless = ClusterStatus(failed_launches=[failed(1, "")])
    assert autoscaler._trouble(nameless) == "a machine of gpu could not be started"


def test_the_first_autoscaler_says_it_in_its_own_report(monkeypatch: pytest.MonkeyPatch) -> None:
    why = {"category": "ICE", "description": "no spot left"}
    kinds = {"gpu": {"is_available": False, "unavailable_node_information": why}}
    summary = {"autoscaler_report": {"node_availability_summary": {"node_availabilities": kinds}}}
    monkeypatch.setattr(autoscaler, "_internal_kv_get", lambda _: json.dumps(summary).encode())
    assert autoscaler._trouble(ClusterStatus()) == "gpu: ICE, no spot left"


@pytest.fixture(scope="module")
def cluster() -> Iterator[tuple[str, dict[str, str]]]:
    with autoscaled(most=2) as found:
        yield found


def come_and_go(address: str, folder: Path) -> list[str]:
    """What a pool says of its machines, in a process that has the cluster's token."""
    said = list[str]()

    def there() -> list[Node]:
        return able(pool.nodes(), cuda=False)  # the head has no cores

    def until(count: int) -> None:
        end = time.monotonic() + 500
        while len(there()) != count and time.monotonic() < end:
            pool.ready(0.5)
        known = sum(node.id in pool.growth().members for node in there())
        said.append(f"{len(there())} nodes, {known} of the group")

    with connect(address, folder) as pool:
        said.append(f"{len(pool.nodes())} with the head, {len(there())} of {pool.growth()}")
        pool.request({"small": 2})
        until(2)
        pool.request({})
        until(0)
    return said


@pytest.mark.nightly
@pytest.mark.system
def test_machines_come_as_requested_and_go_when_they_are_idle(
    cluster: tuple[str, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, variables = cluster
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        said = process.submit(come_and_go, address, tmp_path).result()
    assert said == [
        f"1 with the head, 0 of {Growth((Group('small', 2, 1),))}",
        *("2 nodes, 2 of the group", "0 nodes, 0 of the group"),
    ]
