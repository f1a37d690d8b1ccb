"""The RayJob and the queue of Kueue: schemas, and that they fit together."""

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import ray
import yaml

from panolog.orchestrator.engine.cluster.jobs import RUN_KEY
from tests.deploy.files import DEPLOY, ROOT, load_all, parsed


def schema(name: str) -> Any:
    return json.loads((Path(__file__).parent / f"{name}.schema.json").read_text())


@pytest.fixture
def job() -> Any:
    return load_all("kuberay.yaml")[0]


def pods(job: Any) -> list[Any]:
    cluster = job["spec"]["rayClusterSpec"]
    return [group["template"] for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"])]


def check(kind: Any) -> None:
    kubernetes_validate.validate(kind, kubernetes_validate.latest_version(), strict=True)


def test_kubernetes_would_accept_it(job: Any) -> None:
    jsonschema.validate(job, schema("rayjob"))
    for template in pods(job):
        check({"apiVersion": "v1", "kind": "PodTemplate", "metadata": {"name": "any"}, "template": template})
    for other in load_all("kuberay.yaml")[1:]:
        check(other)


def test_a_worker_that_ends_has_time_to_let_its_tasks_move(job: Any) -> None:
    worker = pods(job)[1]["spec"]
    program, *words = worker["containers"][0]["lifecycle"]["preStop"]["exec"]["command"]
    assert (program, words[:2]) == ("panolog", ["cluster", "leave"])
    assert int(words[2]) < worker["terminationGracePeriodSeconds"]
    assert parsed(words)["seconds"] == int(words[2])


def test_versions_volumes_and_names_fit_together(job: Any) -> None:
    spec = job["spec"]
    cluster = spec["rayClusterSpec"]
    assert cluster["rayVersion"] == ray.__version__
    assert cluster["authOptions"] == {"mode": "token"}
    for template in pods(job):
        volumes = {volume["name"] for volume in template["spec"]["volumes"]}
        assert {mount["name"] for mount in template["spec"]["containers"][0]["volumeMounts"]} == volumes
    claims = {kind["metadata"]["name"] for kind in load_all("kuberay.yaml")[1:]}
    assert pods(job)[0]["spec"]["volumes"][0]["persistentVolumeClaim"]["claimName"] in claims
    assert spec["metadata"] == {RUN_KEY: "/data/runs/street"}
    assert spec["entrypoint"].count(spec["metadata"][RUN_KEY]) == 3
    stop = yaml.safe_load(spec["runtimeEnvYAML"])["env_vars"]["RAY_JOB_STOP_WAIT_TIME_S"]
    assert int(stop) > 60
    assert "panolog-recovery --from-env-file=deploy/recovery.env" in (DEPLOY / "kubernetes.md").read_text()


# Kueue

SUBMITTER = {"cpu": 0.5, "memory": 200 * 2**20}  # KubeRay's default for the pod that submits the job
UNITS = {"Mi": 2**20, "Gi": 2**30, "Ti": 2**40}


@pytest.fixture
def kinds() -> dict[str, Any]:
    return {kind["kind"]: kind for kind in load_all("kueue.yaml")}


def queued() -> Any:
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
        jsonschema.validate(kind, schema("kueue"))
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
    wanted = needs(queued())
    assert wanted.keys() == quota.keys()
    for name, size in wanted.items():
        assert size <= quota[name] < 1.1 * size, name


def test_the_run_is_one_that_kueue_can_suspend() -> None:
    spec = queued()["spec"]
    assert spec["shutdownAfterJobFinishes"] is True
    assert "clusterSelector" not in spec
    assert not spec["rayClusterSpec"].get("enableInTreeAutoscaling")
    assert len(spec["rayClusterSpec"]["workerGroupSpecs"]) <= 7
