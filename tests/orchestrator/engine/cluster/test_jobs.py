"""Runs on a remote Ray cluster: a real head with a job server that requires a token."""

import json
import os
import re
import subprocess
import urllib.request
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from panolog.orchestrator.engine.cluster.jobs import RUN_KEY, Cluster, ClusterJob
from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.config import as_settings, load_config
from panolog.orchestrator.runs.control import state_of
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import TaskStarted
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.watch.follower.receivers import receiver
from tests.ray_head import BIN, Head, free_ports, ray_head, read, wait_until

pytestmark = pytest.mark.system

SMALL = "--device cpu --blocks 2x1x1 --set sky.count=50 --set checkpoint.every=500 --set checkpoint.share=1"


class Ended(NamedTuple):
    exit_code: int
    stdout: str
    stderr: str
    output: str = ""


Panolog = Callable[..., Ended]
invoke = partial(call, "cluster")


@pytest.fixture(scope="module")
def head() -> Iterator[Head]:
    with ray_head() as head:
        yield head


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("cluster") / "town", panoramas=6, width=64, points=200)


def enter(environment: dict[str, str]) -> None:
    os.environ.update(environment)


def ended(*words: object) -> Ended:
    result = invoke(*words)
    return Ended(result.exit_code, result.stdout, result.stderr, result.output)


@pytest.fixture(scope="module")
def panolog(head: Head) -> Iterator[Panolog]:
    """`panolog cluster …` in a process that has the environment of the head, which Ray reads once."""
    with ProcessPoolExecutor(1, get_context("spawn"), enter, (head.environment,)) as process:
        process.submit(os.getpid).result()  # it begins with the fixture, not within a test
        yield lambda *words: process.submit(ended, *words, "--address", head.address).result()


def over(head: Head, job: str) -> bool:
    """Whether the job server says that a job has ended; requested without a process, which takes a second."""
    request = urllib.request.Request(
        f"{head.address}/api/jobs/{job}", headers={"Authorization": f"Bearer {head.token}"}
    )
    with urllib.request.urlopen(request, timeout=60) as reply:
        return json.load(reply)["status"] not in ("PENDING", "RUNNING")


def shown(ended: Any) -> Any:
    assert ended.exit_code == 0, ended.output
    return json.loads(ended.stdout)


def recorded(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[str]]:
    """The commands that a cluster is to begin, which begins none."""
    begun = list[Sequence[str]]()

    class Recorder:
        guarded, address = True, "http://head"

        def begin(self, run: str, words: Sequence[str]) -> ClusterJob:
            begun.append(words)
            return ClusterJob(run, "waiting")

    monkeypatch.setattr("panolog.orchestrator.engine.cluster.jobs.connect", lambda _: Recorder())
    return begun


@pytest.mark.nightly
def test_a_run_is_submitted_watched_stopped_and_resumed(
    head: Head, panolog: Panolog, scene: Path, tmp_path: Path
) -> None:
    root = tmp_path / "rün"
    job = shown(panolog("submit", scene, "-o", root, *SMALL.split(), "--iterations", "100000", "--json"))[
        "job"
    ]
    assert job["status"] in ("waiting", "running")
    assert f"job {job['id']} is driving it" in one_line(panolog("resume", root))

    def iterations() -> list[str]:
        text = read(head.metrics)
        tags = re.escape(str(root).encode("ascii", "backslashreplace").decode().replace("\\", "\\\\"))
        return re.findall(rf'^ray_panolog_iteration{{.*run="{tags}".*task="coarse".* ([\d.e+]+)$', text, re.M)

    wait_until(lambda: state_of(root).task(COARSE).checkpoint or over(head, job["id"]), "a first checkpoint")
    wait_until(iterations, "the metrics of the run")
    assert 0 < float(iterations()[0]) < 100_000
    status = shown(panolog("status", root, "--json"))
    assert (status["status"], status["stage"], status["scene"]) == ("running", "coarse", str(scene))
    assert status["job"] == job | {"status": "running"}

    stopped = shown(panolog("stop", root, "--json"))["job"]
    assert (stopped["id"], stopped["status"]) == (job["id"], "interrupted")
    assert panolog("status", root).stdout.startswith(f"job {job['id']} · stopped\nstopped")
    assert state_of(root).outcome == "interrupted"
    coarse = state_of(root).task(COARSE)
    assert coarse.checkpoint and coarse.progress
    assert coarse.checkpoint >= coarse.progress.iteration  # a fresh one
    assert shown(panolog("resume", root, "--json"))["job"]["id"] != job["id"]
    wait_until(lambda: state_of(root).status(COARSE) == "running", "the run continues")
    records = [stored.record for stored in read_records(RunFolder(root).database)]
    starts = [record.iteration for record in records if isinstance(record, TaskStarted)]
    assert starts == [0, coarse.checkpoint]


@pytest.mark.parametrize(
    ("option", "value", "line"),
    [
        ("--notify", "slack:https://hooks.example/T0PSECRET", "its URL is a secret"),
        ("--notify", "@targets", "the file is on the machine of the run; write it from / on"),
        ("--log", "mlflow:http://me:T0PSECRET@h.example", "user and password belong into"),
        ("--log", "tensorboard:curves", "is on another machine; write it from / on"),
    ],
)
def test_no_secret_becomes_a_word_of_a_job(option: str, value: str, line: str) -> None:
    for command in (("submit", "/scene", "-o", "/runs/a"), ("resume", "/runs/a")):
        said = one_line(invoke(*command, option, value))
        assert line in said
        assert "T0PSECRET" not in said


def test_notifications_sinks_and_settings_are_words_of_the_job(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """References are those of the head: nothing is read here, and they come there as they are."""
    begun = recorded(monkeypatch)
    monkeypatch.setenv("PANOLOG_NOTIFY", "slack:https://hooks.example/T0PSECRET")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    (tmp_path / "netrc").write_text("not its format")
    settings = tmp_path / "settings.yaml"  # of this machine: the head receives its content
    settings.write_text("iterations: 10\n")
    given = ["--notify", "slack:@/etc/panolog/slack.url", "--notify", "env:TARGETS", "--notify", "@~/more"]
    given += ["--notify", "webhook:https://h.example/hook", "--notify", "mail:smtp://h.example/a@b.c"]
    given += ["--log", "mlflow", "--log", "tensorboard:/curves", "--log", "wandb:place"]
    given += ["--at-end", "ray down -y /etc/cluster.yaml"]
    submit = ("submit", "/data/town", "-o", "/runs/a", "--config", settings)
    for command in (submit, ("resume", "/runs/a")):
        assert invoke(*command, *given).exit_code == 0
        words = list(begun.pop())
        assert words[-len(given) - 3 : -3] == given
        assert ("iterations=10" in words) == (command == submit)


@pytest.mark.nightly
def test_a_wrong_token_is_one_line(head: Head, tmp_path: Path) -> None:
    command = [f"{BIN}/panolog", "cluster", "status", "/run", "--address", head.address]
    ours = head.environment | {"RAY_AUTH_TOKEN": "0" * 64, "HOME": str(tmp_path)}
    done = subprocess.run(command, check=False, env=ours, capture_output=True, text=True)
    said = one_line(Ended(done.returncode, done.stdout, done.stderr))
    assert "Invalid authentication token" in said and "~/.ray/auth_token" in said


def test_no_job_server_answers() -> None:
    (port,) = free_ports(1)
    assert "no job server" in one_line(invoke("stop", "/run", "--address", f"http://127.0.0.1:{port}"))
    with receiver() as server:  # another one
        assert "no job server" in one_line(invoke("status", "/run", "--address", server.url))


def test_what_needs_no_server_to_be_refused() -> None:
    assert "write http://HOST:8265" in one_line(invoke("status", "/run", "--address", "127.0.0.1:6379"))
    for command in (("submit", "/scene", "-o", "runs/a"), ("resume", "runs/a"), ("stop", "runs/a")):
        assert "runs/a: is on the cluster's head node" in one_line(invoke(*command))
    assert "SCENE town" in one_line(invoke("submit", "town", "-o", "/run"))
    assert "did you mean sky.count?" in one_line(
        invoke("submit", "/scene", "-o", "/run", "--set", "sky.cuont=3")
    )


def test_settings_survive_the_way_to_the_head() -> None:
    sets = ("depth.w0=1e-05", "sky.count=7", "width=null", "refine=false", "seed=3")
    config = load_config(None, sets, {"blocks": "1x2x3"})
    options = as_settings(config)
    assert set(options[::2]) == {"--set"}
    assert load_config(None, options[1::2]) == config


def test_a_run_of_panoramas_is_submitted_with_how_its_scene_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = recorded(monkeypatch)
    given = ["--trajectory", "/data/walk.tum", "--nadir", "12.0", "--no-static", "--partial"]
    given += ["--mask-model", "/data/people.onnx", "--depth-model", "/data/m.onnx"]
    assert invoke("submit", "/data/walk.mp4", "-o", "/runs/a", *given).exit_code == 0
    (words,) = begun
    assert list(words[:5]) == ["panolog", "run", "/data/walk.mp4", "-o", "/runs/a"]
    assert all(word in words for word in given)
    elsewhere = invoke("submit", "/data/walk.mp4", "-o", "/runs/a", "--trajectory", "walk.tum")
    assert "--trajectory walk.tum: is on the cluster's head node" in one_line(elsewhere)


class Client:
    """A client of a job server that has had one job of /runs/a and answers `panolog status` there."""

    def __init__(self, status: str, message: str = "", said: str = "") -> None:
        self.submitted: list[dict[str, Any]] = []
        self._job = SimpleNamespace(
            **{"submission_id": "job", "status": SimpleNamespace(value=status), "message": message},
            **{"driver_exit_code": 2, "start_time": 1, "metadata": {RUN_KEY: "/runs/a"}},
        )
        self._said = b64encode(said.encode()).decode()

    def list_jobs(self) -> list[object]:
        return [self._job]

    def submit_job(self, **job: Any) -> str:
        self.submitted.append(job)
        return "another"

    def get_job_info(self, _: str) -> object:
        return self._job

    def get_job_logs(self, _: str) -> str:
        return f"of Ray\npanolog-output {self._said}\n"

    def delete_job(self, name: str) -> None:
        assert name == "another"


def test_a_job_that_failed_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    message = "Traceback\npanolog: /none: there is no such folder"
    cluster = Cluster("http://head:8265", Client("FAILED", message, "panolog: is no run"), guarded=True)
    monkeypatch.setattr("panolog.orchestrator.engine.cluster.jobs.connect", lambda _: cluster)
    failed, why = shown(invoke("status", "/runs/a", "--json")), "/none: there is no such folder"
    assert (failed["status"], failed["run"], failed["reason"]) == ("failed", "/runs/a", why)
    assert failed["job"] == {"id": "job", "status": "failed", "exit_code": 2, "reason": why}
    assert invoke("status", "/runs/a").stdout == f"job job · failed · {why}\n"
    assert "no job on the cluster" in one_line(invoke("stop", "/runs/a"))
    assert "is no run" in one_line(invoke("status", "/runs/other"))


@pytest.mark.parametrize("level", [None, "DEBUG"])
def test_a_job_logs_as_the_command_that_starts_it(monkeypatch: pytest.MonkeyPatch, level: str | None) -> None:
    monkeypatch.delenv(log.VARIABLE, raising=False)
    if level:
        monkeypatch.setenv(log.VARIABLE, level)
    client = Client("SUCCEEDED")
    assert Cluster("http://head:8265", client, guarded=True).begin("/runs/a", ["panolog", "run"]).over
    assert client.submitted[0]["runtime_env"]["env_vars"].get(log.VARIABLE) == level
