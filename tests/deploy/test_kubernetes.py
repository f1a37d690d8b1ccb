"""The RayJob: Kubernetes' own schemas for what is Kubernetes', ours for what KubeRay adds."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import ray
import yaml

from panolog.orchestrator.engine.cluster.jobs import RUN_KEY
from tests.deploy.files import DEPLOY, load_all, parsed

SCHEMA = json.loads((Path(__file__).parent / "rayjob.schema.json").read_text())


@pytest.fixture
def job() -> Any:
    return load_all("kuberay.yaml")[0]


def pods(job: Any) -> list[Any]:
    cluster = job["spec"]["rayClusterSpec"]
    return [group["template"] for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"])]


def check(kind: Any) -> None:
    kubernetes_validate.validate(kind, kubernetes_validate.latest_version(), strict=True)


def test_kubernetes_would_accept_it(job: Any) -> None:
    jsonschema.validate(job, SCHEMA)
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
