"""Runs on a remote Ray cluster: a real head with a job server that requires a token."""

import json
import os
import re
import subprocess
import threading
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.cluster.jobs import Cluster, ClusterJob
from panolog.orchestrator.run import log
from panolog.orchestrator.run.config import as_settings, load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import TaskStarted
from panolog.orchestrator.run.state import RunState, replay
from panolog.orchestrator.run.store import read_milestones, read_records
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.orchestrator.follower.receivers import receiver
from tests.orchestrator.messages import without_progress
from tests.ray_head import BIN, Head, free_ports, ray_head, read, wait_until

pytestmark = pytest.mark.system

SMALL: tuple[str, ...] = (
    "--device",
    "cpu",
    "--set",
    "sky.count=50",
    "--set",
    "checkpoint.every=500",
    "--blocks",
    "2x1x1",
)
SMALL += ("--set", "checkpoint.share=1")


@dataclass
class Ended:
    """How a command has ended."""

    code: int
    stdout: str
    stderr: str


Panolog = Callable[..., Ended]


@pytest.fixture(scope="module")
def head() -> Iterator[Head]:
    with ray_head() as head:
        yield head


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("cluster") / "town", panoramas=6, width=64, points=200)


def enter(environment: dict[str, str]) -> None:
    os.environ.update(environment)


def invoke(*words: object) -> Ended:
    result = CliRunner().invoke(app.app, ["cluster", *map(str, words)])
    return Ended(result.exit_code, result.stdout, result.stderr)


@pytest.fixture(scope="module")
def panolog(head: Head) -> Iterator[Panolog]:
    """`panolog cluster …` in a process that has the environment of the head, which Ray reads once."""
    with ProcessPoolExecutor(1, get_context("spawn"), enter, (head.environment,)) as process:
        process.submit(os.getpid).result()  # it begins with the fixture, not within a test
        yield lambda *words: process.submit(invoke, *words, "--address", head.address).result()


def described(head: Head, job: str) -> str:
    """All that the job server says of a job; requested without a process, which takes a second."""
    request = urllib.request.Request(
        f"{head.address}/api/jobs/{job}", headers={"Authorization": f"Bearer {head.token}"}
    )
    with urllib.request.urlopen(request, timeout=10) as reply:
        text: str = reply.read().decode()
    return text


def over(head: Head, job: str) -> bool:
    """Whether the job server says that a job has ended."""
    return json.loads(described(head, job))["status"] not in ("PENDING", "RUNNING")


def shown(ended: Ended) -> Any:
    """What it printed as JSON."""
    assert ended.code == 0, ended.stderr
    return json.loads(ended.stdout)


def one_line(ended: Ended) -> str:
    assert (ended.code, ended.stdout) == (2, ""), ended.stderr
    lines = without_progress(ended.stderr)
    assert len(lines) == 1, ended.stderr
    return lines[0]


def recorded(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[str]]:
    """The commands that a cluster is to begin, which begins none."""
    begun = list[Sequence[str]]()

    class Recorder:
        guarded, address = True, "http://head"

        def begin(self, run: str, words: Sequence[str]) -> ClusterJob:
            begun.append(words)
            return ClusterJob(run, "waiting")

    monkeypatch.setattr("panolog.orchestrator.cluster.jobs.connect", lambda _: Recorder())
    return begun


def state_of(root: Path) -> RunState:
    database = RunFolder(root).database
    return replay(read_milestones(database)) if database.exists() else RunState()


def starts(root: Path) -> list[int]:
    """The iterations at which workers have begun."""
    records = [stored.record for stored in read_records(RunFolder(root).database)]
    return [record.iteration for record in records if isinstance(record, TaskStarted)]


def test_a_run_is_submitted_watched_stopped_and_resumed(
    head: Head, panolog: Panolog, scene: Path, tmp_path: Path
) -> None:
    root = tmp_path / "rün"
    job = shown(panolog("submit", scene, "-o", root, *SMALL, "--iterations", "100000", "--json"))["job"]
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
    wait_until(lambda: starts(root) == [0, coarse.checkpoint], "the run continues")
    shown(panolog("stop", root, "--json"))


def test_a_run_to_its_end(head: Head, panolog: Panolog, scene: Path, tmp_path: Path) -> None:
    root = tmp_path / "run"
    settings = tmp_path / "settings.yaml"  # of this machine: the head receives its content
    settings.write_text("iterations: 10\nrefine: false\n")
    hook = tmp_path / "hook"
    with receiver() as server:
        hook.write_text(f"{server.url}/T0PSECRET")
        hook.chmod(0o600)
        passing = ("--notify", f"webhook:@{hook}", "--log", "tensorboard")
        ended = panolog("submit", scene, "-o", root, *SMALL, *passing, "--config", settings)
        assert re.fullmatch(r"raysubmit_\w+\n", ended.stdout), ended.stderr
        assert "panolog cluster status" in ended.stderr
        wait_until(lambda: over(head, ended.stdout.strip()), "the job has ended")
    assert [(it.path, it.json["type"]) for it in server.received] == [("/T0PSECRET", "run.done")]
    assert "T0PSECRET" not in described(head, ended.stdout.strip())
    assert list((root / "tensorboard").rglob("events.out.tfevents.*"))
    shown = panolog("status", root)
    assert shown.code == 0, shown.stderr
    assert shown.stdout.startswith(f"job {ended.stdout.strip()} · done\ndone"), shown.stdout
    coarse = state_of(root).task(COARSE).progress
    assert coarse and coarse.iterations == 10


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
        said = refused(*command, option, value)
        assert line in said
        assert "T0PSECRET" not in said


def test_notifications_and_sinks_are_words_of_the_job(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """References are those of the head: nothing is read here, and they come there as they are."""
    begun = recorded(monkeypatch)
    monkeypatch.setenv("PANOLOG_NOTIFY", "slack:https://hooks.example/T0PSECRET")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    (tmp_path / "netrc").write_text("not its format")
    given = ["--notify", "slack:@/etc/panolog/slack.url", "--notify", "env:TARGETS", "--notify", "@~/more"]
    given += ["--notify", "webhook:https://h.example/hook", "--notify", "mail:smtp://h.example/a@b.c"]
    given += ["--log", "mlflow", "--log", "tensorboard:/curves", "--log", "wandb:place"]
    for command in (("submit", "/data/town", "-o", "/runs/a"), ("resume", "/runs/a")):
        ended = CliRunner().invoke(app.app, ["cluster", *command, *given])
        assert ended.exit_code == 0, ended.output
        assert list(begun.pop()[-len(given) - 3 : -3]) == given


def test_a_job_that_fails_says_why(head: Head, panolog: Panolog, tmp_path: Path) -> None:
    root = tmp_path / "run"
    job = shown(panolog("submit", tmp_path / "none", "-o", root, "--json"))["job"]
    wait_until(lambda: over(head, job["id"]), "the job has failed")
    failed = shown(panolog("status", root, "--json"))
    assert failed["status"] == failed["job"]["status"] == "failed"
    assert (failed["run"], failed["job"]["exit_code"]) == (str(root), 2)
    assert "none: there is no such folder" in failed["reason"]
    assert "no job on the cluster" in one_line(panolog("stop", root))
    assert "is not a run folder" in one_line(panolog("status", tmp_path / "other"))


@pytest.mark.parametrize(
    ("token", "line", "hint"),
    [("0" * 64, "Invalid authentication token", "~/.ray/auth_token"), ("", "RAY_AUTH_TOKEN_PATH", "")],
)
def test_a_wrong_token_and_none(head: Head, tmp_path: Path, token: str, line: str, hint: str) -> None:
    command = [f"{BIN}/panolog", "cluster", "status", "/run", "--address", head.address]
    ours = head.environment | {"RAY_AUTH_TOKEN": token, "HOME": str(tmp_path)}
    ended = subprocess.run(command, check=False, env=ours, capture_output=True, text=True)
    said = one_line(Ended(ended.returncode, ended.stdout, ended.stderr))
    assert line in said
    assert hint in said


class _NotRay(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html>")

    def log_message(self, *_: object) -> None:
        """Says nothing."""


def refused(*arguments: object) -> str:
    """The one line of a command that does not come as far as Ray."""
    return one_line(invoke(*arguments))


def test_no_job_server_answers() -> None:
    (port,) = free_ports(1)
    assert "no job server" in refused("stop", "/run", "--address", f"http://127.0.0.1:{port}")
    with HTTPServer(("127.0.0.1", 0), _NotRay) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        address = f"http://127.0.0.1:{server.server_port}"
        assert "no job server" in refused("status", "/run", "--address", address)
        server.shutdown()
        thread.join()


def test_what_needs_no_server_to_be_refused() -> None:
    assert "write http://HOST:8265" in refused("status", "/run", "--address", "127.0.0.1:6379")
    for command in (("submit", "/scene", "-o", "runs/a"), ("resume", "runs/a"), ("stop", "runs/a")):
        assert "runs/a: is on the cluster's head node" in refused(*command)
    assert "SCENE town" in refused("submit", "town", "-o", "/run")
    assert "did you mean sky.count?" in refused("submit", "/scene", "-o", "/run", "--set", "sky.cuont=3")


def test_settings_survive_the_way_to_the_head() -> None:
    sets = ("depth.w0=1e-05", "sky.count=7", "width=null", "refine=false", "seed=3")
    config = load_config(None, sets, {"blocks": "1x2x3"})
    options = as_settings(config)
    assert set(options[::2]) == {"--set"}
    assert load_config(None, options[1::2]) == config


def test_a_run_of_panoramas_is_submitted_with_how_its_scene_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = recorded(monkeypatch)
    given = ["--trajectory", "/data/walk.tum", "--nadir", "12.0", "--no-static", "--partial"]
    given += ["--depth-model", "/data/m.onnx"]
    ended = CliRunner().invoke(app.app, ["cluster", "submit", "/data/walk.mp4", "-o", "/runs/a", *given])
    assert ended.exit_code == 0, ended.output
    (words,) = begun
    assert list(words[:5]) == ["panolog", "run", "/data/walk.mp4", "-o", "/runs/a"]
    assert all(word in words for word in given)
    assert "--trajectory walk.tum: is on the cluster's head node" in refused(
        "submit", "/data/walk.mp4", "-o", "/runs/a", "--trajectory", "walk.tum"
    )


@pytest.mark.parametrize("level", [None, "DEBUG"])
def test_a_job_logs_as_the_command_that_starts_it(monkeypatch: pytest.MonkeyPatch, level: str | None) -> None:
    submitted: dict[str, Any] = {}
    info = SimpleNamespace(
        submission_id="job", status=SimpleNamespace(value="PENDING"), driver_exit_code=None, message=""
    )

    class Recorder:
        """The client of a job server."""

        list_jobs = staticmethod(list[object])
        submit_job = staticmethod(lambda **job: submitted.update(job) or "job")
        get_job_info = staticmethod(lambda _: info)

    monkeypatch.delenv(log.VARIABLE, raising=False)
    if level:
        monkeypatch.setenv(log.VARIABLE, level)
    Cluster("http://head:8265", Recorder(), guarded=True).begin("/runs/a", ["panolog", "run"])
    assert submitted["runtime_env"]["env_vars"].get(log.VARIABLE) == level
