"""`panolog queue`: what is added is checked as by `run`, and comes back as its words; two real runs."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.queue.entries import Needs, State
from panolog.orchestrator.queue.store import opened
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.store import read_records
from panolog.synthetic.make import make_town
from tests.ray_head import environment, wait_until

SETTINGS = ["--iterations", "60", "--device", "cpu", "--blocks", "1", "--width", "64"]
SETTINGS += ["--set", "sky.count=100", "--set", "checkpoint.every=10", "--set", "checkpoint.share=1"]
SETTINGS += ["--set", "refine=false", "--set", "deliver=false"]


PRICES = Path(__file__).parents[3] / "deploy" / "prices.toml"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("queued") / "town", panoramas=9, width=64, points=300)


@pytest.fixture
def here(tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PANOLOG_QUEUE", str(tmp_path / "queue"))
    monkeypatch.chdir(scene.parent)
    return tmp_path


def panolog(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app.app, list(map(str, words)))
    return result.exit_code, result.stdout, result.stderr.strip()


def test_the_words_of_a_run_come_back_with_absolute_paths(here: Path, scene: Path) -> None:
    settings = here / "settings.yaml"
    settings.write_text("iterations: 70\n")
    words = ["--config", os.path.relpath(settings), "--set", "sky.count=9", "--set", "seed=3", "--nice", "5"]
    words += ["--address", "auto", "--max-resumes", "4", "--supervise", "--log", "tensorboard", "--dashboard"]
    assert panolog("queue", "add", "town", "-o", os.path.relpath(here / "run"), *words)[:2] == (0, "1\n")
    with opened(here / "queue", make=False) as queue:
        command = queue.entry(1).command
    assert (command.run, command.folder) == (here / "run", scene.parent)
    assert Path(command.first[0]) == scene
    options = ["--set", "sky.count=9", "--set", "seed=3", "--address", "auto", "--nice", "5", "--dashboard"]
    later = ["--address", "auto", "--nice", "5", "--dashboard", "--max-resumes", "4", "--log", "tensorboard"]
    config = Path(command.first[command.first.index("--config") + 1])
    assert config.is_absolute() and config.samefile(settings)
    rest = [word for word in command.first if word not in ("--config", str(config))]
    assert rest == [
        str(scene),
        "--output",
        str(here / "run"),
        *options,
        "--max-resumes",
        "4",
        "--log",
        "tensorboard",
    ]
    assert list(command.later) == later


def test_limits_are_given_to_the_start_alone(here: Path, scene: Path) -> None:
    words = ["--prices", os.path.relpath(PRICES), "--max-cost", "9", "--deadline", "3h"]
    assert panolog("queue", "add", scene, "-o", here / "run", *words)[0] == 0
    with opened(here / "queue", make=False) as queue:
        command = queue.entry(1).command
    assert command.first[-6:] == ("--prices", str(PRICES), "--max-cost", "9", "--deadline", "3h")
    assert command.later == ()  # the run itself has them
    said = " ".join(panolog("queue", "add", "--help")[1].replace("│", " ").split())
    assert "so long from the start of the run, not from now" in said


def test_a_share_is_given_or_follows_from_the_device(here: Path, scene: Path) -> None:
    given = {
        "a": ([], Needs()),
        "b": (["--gpus", "2", "--cores", "3", "--ram", "1.5"], Needs(2, 3, 3 * 2**29)),
        "c": (["--device", "cpu"], Needs(gpus=0)),
        "d": (["--set", "device=cpu", "--cores", "1"], Needs(0, 1)),
        "e": (["--address", "auto"], None),
    }
    for number, (name, (words, needs)) in enumerate(given.items(), 1):
        assert panolog("queue", "add", scene, "-o", here / name, *words)[0] == 0
        with opened(here / "queue", make=False) as queue:
            assert queue.entry(number).command.needs == needs
            assert not {"--gpus", "--cores", "--ram"} & {*queue.entry(number).command.first}
    assert "waiting      " + f"{here}/b  (2 GPUs, 3 cores, 1.5 GiB)" in panolog("queue", "list")[1]
    rows = json.loads(panolog("queue", "list", "--json")[1])["entries"]
    assert rows[1]["needs"] == {"gpus": 2, "cores": 3, "memory": 3 * 2**29}
    assert (rows[4]["needs"], rows[1]["share"]) == (None, None)


def test_a_run_that_found_no_room_is_given_more(here: Path, scene: Path) -> None:
    for name, words in (("a", ["--gpus", "1", "--ram", "2"]), ("b", ["--address", "auto"])):
        assert panolog("queue", "add", scene, "-o", here / name, *words)[0] == 0
    with opened(here / "queue", make=False) as queue:
        for number in (1, 2):
            queue.claim(number)
            queue.end(number, State.FAILED, 2, "needs about 6.8 GiB of memory, and 2.0 GiB are free")
        assert panolog("queue", "retry", 1, "--ram", 8, "--cores", 2)[0] == 0
        assert (queue.entry(1).command.needs, queue.entry(1).state) == (Needs(1, 2, 2**33), State.WAITING)
        code, _, line = panolog("queue", "retry", 2, "--ram", 8)
        assert (code, line.partition(": ")[2]) == (
            2,
            "entry 2 is a run on a cluster, which Ray divides; leave the options out",
        )
        assert panolog("queue", "retry", 2)[0] == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["town", "-o", "{}/run", "--address", "auto", "--ram", "2"], "--ram 2.0: with --address Ray"),
        (["town", "-o", "{}/run", "--device", "cpu", "--gpus", "1"], "--gpus 1: the run computes on the CPU"),
        (["town", "-o", "{}/run", "--device", "cuda", "--gpus", "0"], "--gpus 0: the run computes on a GPU"),
        (
            ["town", "-o", "{}/run", "--set", "sky.cuont=1"],
            "unknown setting sky.cuont; did you mean sky.count?",
        ),
        (["nowhere", "-o", "{}/run"], "nowhere"),
        (["town", "-o", "{}/taken"], "is not empty and not a run; choose another output folder"),
        (
            ["town", "-o", "{}/made"],
            "is a run already; `panolog resume {}/made` resumes it, or give another -o",
        ),
        (["town", "-o", "{}/run", "--no-gps"], "is a scene already; leave out the options for panoramas"),
        (["town", "-o", "{}/run", "--log", "paper"], "--log paper: there is no such sink"),
        (["town", "-o", "s3://bucket/run"], "takes files and folders of this machine only"),
        (["town", "-o", "{}/run", "--local", "{}/x"], "--local: is for runs with a URL"),
        (["town", "-o", "{}/run", "--max-cost", "much"], "much"),
        (["town", "-o", "{}/run", "--notify", "slack:https://h.example/x"], "slack"),
    ],
)
def test_wrong_input_is_refused_when_it_is_added(here: Path, words: list[str], line: str) -> None:
    (here / "taken").mkdir()
    (here / "taken" / "file").touch()
    (here / "made").mkdir()
    (here / "made" / "run.json").write_text("{}")
    code, stdout, stderr = panolog("queue", "add", *(word.replace("{}", str(here)) for word in words))
    assert (code, stdout, len(stderr.splitlines())) == (2, "", 1)
    assert line.replace("{}", str(here)) in stderr
    assert not (here / "queue").exists()


def test_the_list_and_what_changes_it(here: Path) -> None:
    assert (
        panolog("queue", "list")[2]
        == f"panolog: {here}/queue: has no queue yet; `panolog queue add` makes one"
    )
    for name in "abc":
        assert panolog("queue", "add", "town", "-o", here / name)[0] == 0
    assert panolog("queue", "move", 3, "--first")[0] == panolog("queue", "remove", 1)[0] == 0
    assert panolog("queue", "list")[1].splitlines() == [
        f"3  waiting      {here}/c",
        f"2  waiting      {here}/b",
        "no runner is at work: `panolog queue run` starts one",
    ]
    shown = json.loads(panolog("queue", "list", "--json", "--all")[1])
    assert (shown["queue"], shown["runner"]) == (str(here / "queue"), False)
    assert [(entry["id"], entry["state"]) for entry in shown["entries"]] == [
        (3, "waiting"),
        (1, "removed"),
        (2, "waiting"),
    ]
    assert shown["entries"][0]["command"].startswith("panolog run /")
    assert (
        panolog("queue", "move", 2)[2] == "panolog: queue move: give one of --before ID, --first and --last"
    )
    assert panolog("queue", "retry", 2)[0] == 2


def test_looking_at_a_queue_and_running_it_imports_neither_torch_nor_ray() -> None:
    code = "import sys, panolog.orchestrator.cli.app, panolog.orchestrator.queue.view"
    code += "; print({'torch', 'ray', 'cv2', 'pydantic'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.system
def test_two_real_runs_whose_runner_is_killed(here: Path, scene: Path) -> None:
    """The first run is resumed by the second runner, then the other one starts; both end with equal bytes."""
    for name in ("first", "second"):
        assert panolog("queue", "add", "town", "-o", here / name, *SETTINGS)[0] == 0

    def start() -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "panolog.orchestrator.cli", "queue", "run"]
        return subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=environment(), start_new_session=True
        )

    def begun(name: str) -> list[RunBegan]:
        database = RunFolder(here / name).database
        records = [item.record for item in read_records(database)] if database.exists() else []
        return [record for record in records if isinstance(record, RunBegan)]

    runner = start()
    checkpoint = here / "first" / "coarse" / "checkpoint.safetensors"
    wait_until(lambda: checkpoint.exists() or runner.poll() is not None, "a checkpoint")
    os.kill(runner.pid, signal.SIGKILL)
    runner.communicate()
    runner = start()
    _, said = runner.communicate(timeout=300)
    assert runner.returncode == 0, said
    lines = said.splitlines()
    assert lines[0] == f"panolog: resumed 1: {here}/first"
    assert lines[1:] == [
        f"panolog: done 1: {here}/first",
        f"panolog: started 2: {here}/second",
        f"panolog: done 2: {here}/second",
    ]
    assert [record.resumed for record in begun("first")] == [False, True]
    assert [record.resumed for record in begun("second")] == [False]
    models = [(here / name / "point_cloud.ply").read_bytes() for name in ("first", "second")]
    assert models[0] == models[1]
