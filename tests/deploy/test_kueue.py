"""The queue of Kueue: its objects, and that they fit the RayJob of kuberay.yaml."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from tests.deploy.files import DEPLOY, ROOT, load_all

SCHEMA = json.loads((Path(__file__).parent / "kueue.schema.json").read_text())
SUBMITTER = {"cpu": 0.5, "memory": 200 * 2**20}  # KubeRay's default for the pod that submits the job
UNITS = {"Mi": 2**20, "Gi": 2**30, "Ti": 2**40}


@pytest.fixture
def kinds() -> dict[str, Any]:
    return {kind["kind"]: kind for kind in load_all("kueue.yaml")}


def job() -> Any:
    """The RayJob as the command of kueue.md makes it, before it gets its label."""
    page = (DEPLOY / "kueue.md").read_text()
    (command,) = re.findall(r"^    (sed '.*?' deploy/kuberay\.yaml)", page, re.MULTILINE)
    made = subprocess.run(command, shell=True, cwd=ROOT, check=True, capture_output=True, text=True)
    return next(yaml.safe_load_all(made.stdout))


def amount(text: str) -> float:
    return float(text[:-2]) * UNITS[text[-2:]] if text[-2:] in UNITS else float(text)


def needs(job: Any) -> dict[str, float]:
    """What a run requests of the cluster: Kubernetes takes limits where nothing is requested."""
    cluster = job["spec"]["rayClusterSpec"]
    groups = [(1, cluster["headGroupSpec"]), *((it["replicas"], it) for it in cluster["workerGroupSpecs"])]
    total = dict(SUBMITTER)
    for count, group in groups:
        for container in group["template"]["spec"]["containers"]:
            resources = container["resources"]
            for name, text in (resources["limits"] | resources["requests"]).items():
                total[name] = total.get(name, 0.0) + count * amount(text)
    return total


def test_its_objects_are_what_kueue_takes(kinds: dict[str, Any]) -> None:
    for kind in kinds.values():
        jsonschema.validate(kind, SCHEMA)
    assert set(kinds) == {"ResourceFlavor", "ClusterQueue", "LocalQueue", "WorkloadPriorityClass"}


def test_names_fit_together(kinds: dict[str, Any]) -> None:
    (group,) = kinds["ClusterQueue"]["spec"]["resourceGroups"]
    (flavor,) = group["flavors"]
    assert flavor["name"] == kinds["ResourceFlavor"]["metadata"]["name"]
    assert [resource["name"] for resource in flavor["resources"]] == group["coveredResources"]
    assert kinds["LocalQueue"]["spec"]["clusterQueue"] == kinds["ClusterQueue"]["metadata"]["name"]
    page = (DEPLOY / "kueue.md").read_text()
    assert f"kueue.x-k8s.io/queue-name={kinds['LocalQueue']['metadata']['name']} " in page
    assert f"kueue.x-k8s.io/priority-class={kinds['WorkloadPriorityClass']['metadata']['name']}`" in page


def test_the_quota_is_that_of_one_run(kinds: dict[str, Any]) -> None:
    (group,) = kinds["ClusterQueue"]["spec"]["resourceGroups"]
    quota = {it["name"]: amount(it["nominalQuota"]) for it in group["flavors"][0]["resources"]}
    wanted = needs(job())
    assert wanted.keys() == quota.keys()
    for name, size in wanted.items():
        assert size <= quota[name] < 1.1 * size, name


def test_the_run_is_one_that_kueue_can_suspend() -> None:
    spec = job()["spec"]
    assert spec["shutdownAfterJobFinishes"] is True
    assert "clusterSelector" not in spec
    assert not spec["rayClusterSpec"].get("enableInTreeAutoscaling")
    assert len(spec["rayClusterSpec"]["workerGroupSpecs"]) <= 7
