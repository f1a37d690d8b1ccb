"""`panolog queue`: what is added is checked as by `run`, and comes back as its words."""

import os
import shutil
from pathlib import Path

import pytest

from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.queue.database import opened
from panolog.orchestrator.runs.queue.entries import Needs, State
from tests.orchestrator.cli.program import call, one_line, shown
from tests.orchestrator.history import begun
from tests.scenes import write_scene

pytestmark = pytest.mark.system

PRICES = Path(__file__).parents[3] / "deploy" / "prices.toml"


@pytest.fixture
def here(tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PANOLOG_QUEUE", str(tmp_path / "queue"))
    monkeypatch.chdir(scene.parent)
    return tmp_path


def add(here: Path, name: str, *words: object) -> str:
    """Adds the run `name`; returns what is printed."""
    result = call("queue", "add", "town", "-o", here / name, *words)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_words_of_a_run_come_back_with_absolute_paths(here: Path, scene: Path) -> None:
    settings = here / "settings.yaml"
    settings.write_text("iterations: 70\n")
    words = ["--config", os.path.relpath(settings), "--set", "sky.count=9", "--set", "seed=3", "--nice", "5"]
    more = ["--address", "auto", "--max-resumes", "4", "--supervise", "--log", "tensorboard", "--dashboard"]
    limits = ["--prices", os.path.relpath(PRICES), "--max-cost", "9", "--deadline", "3h"]
    run = os.path.relpath(here / "run")
    assert call("queue", "add", "town", "-o", run, *words, *more, *limits).stdout == "1\n"
    with opened(here / "queue", make=False) as queue:
        command = queue.entry(1).command
    assert (command.run, command.folder) == (here / "run", scene.parent)
    config = Path(command.first[command.first.index("--config") + 1])
    assert config.is_absolute() and config.samefile(settings)
    assert [word for word in command.first if word not in ("--config", str(config))] == [
        *(str(scene), "--output", str(here / "run"), "--set", "sky.count=9", "--set", "seed=3"),
        *command.later,
        *("--prices", str(PRICES), "--max-cost", "9", "--deadline", "3h"),  # the run itself has them then
    ]
    assert list(command.later) == [
        *("--address", "auto", "--nice", "5", "--dashboard", "--max-resumes", "4", "--log", "tensorboard")
    ]
    said = " ".join(call("queue", "add", "--help").stdout.replace("│", " ").split())
    assert "so long from the start of the run, not from now" in said


def test_run_and_resume_take_the_words_of_a_queue(
    here: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`run` and `resume` get the words that the runner passes on for a run that was added elsewhere."""
    given: list[tuple[object, ...]] = []
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    for name in ("start", "resume"):
        monkeypatch.setattr(
            f"panolog.orchestrator.cli.session.session.{name}", lambda *given_, **_: given.append(given_)
        )
    add(here, "run", "--set", "sky.count=9", "--iterations", "70", "--nice", "5", "--address", "auto")
    with opened(here / "queue", make=False) as queue:
        command = queue.entry(1).command
    monkeypatch.chdir(here)
    assert call("run", *command.first).exit_code == 0
    begun(here / "run")
    assert call("resume", here / "run", *command.later).exit_code == 0
    source, root, config, address, *_, nice = given[0][:7]
    assert isinstance(config, RunConfig)
    assert (Path(str(source)), root, address, nice) == (scene, here / "run", "auto", 5)
    assert (config.sky.count, config.iterations) == (9, 70)
    assert (given[1][0], given[1][1], given[1][4]) == (here / "run", "auto", 5)


def test_a_share_is_given_or_follows_from_the_device(here: Path) -> None:
    given = {
        "a": ([], Needs()),
        "b": (["--gpus", "2", "--cores", "3", "--ram", "1.5"], Needs(2, 3, 3 * 2**29)),
        "c": (["--device", "cpu"], Needs(gpus=0)),
        "d": (["--set", "device=cpu", "--cores", "1"], Needs(0, 1)),
        "e": (["--address", "auto"], None),
    }
    for number, (name, (words, needs)) in enumerate(given.items(), 1):
        add(here, name, *words)
        with opened(here / "queue", make=False) as queue:
            assert queue.entry(number).command.needs == needs
            assert not {"--gpus", "--cores", "--ram"} & {*queue.entry(number).command.first}
    assert f"waiting      {here}/b  (2 GPUs, 3 cores, 1.5 GiB)" in call("queue", "list").stdout
    rows = shown("queue", "list")["entries"]
    assert rows[1]["needs"] == {"gpus": 2, "cores": 3, "memory": 3 * 2**29}
    assert (rows[4]["needs"], rows[1]["share"]) == (None, None)


def test_a_run_that_found_no_room_is_given_more(here: Path) -> None:
    add(here, "a", "--gpus", "1", "--ram", "2")
    add(here, "b", "--address", "auto")
    with opened(here / "queue", make=False) as queue:
        for number in (1, 2):
            queue.claim(number)
            queue.end(number, State.FAILED, 2, "needs about 6.8 GiB of memory, and 2.0 GiB are free")
        assert call("queue", "retry", 1, "--ram", 8, "--cores", 2).exit_code == 0
        assert (queue.entry(1).command.needs, queue.entry(1).state) == (Needs(1, 2, 2**33), State.WAITING)
        line = one_line(call("queue", "retry", 2, "--ram", 8))
        assert line.endswith(": entry 2 is a run on a cluster, which Ray divides; leave the options out")
        assert call("queue", "retry", 2).exit_code == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["town", "-o", "{}/run", "--address", "auto", "--ram", "2"], "--ram 2.0: with --address Ray"),
        (["town", "-o", "{}/run", "--device", "cpu", "--gpus", "1"], "--gpus 1: the run computes on the CPU"),
        (["town", "-o", "{}/run", "--device", "cuda", "--gpus", "0"], "--gpus 0: the run computes on a GPU"),
        (["town", "-o", "{}/run", "--set", "sky.cuont=1"], "did you mean sky.count?"),
        (["nowhere", "-o", "{}/run"], "nowhere"),
        (["town", "-o", "{}/taken"], "is not empty and not a run; choose another output folder"),
        (["town", "-o", "{}/made"], "is a run already; `panolog resume {}/made` resumes it, or give"),
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
    result = call("queue", "add", *(word.replace("{}", str(here)) for word in words))
    assert line.replace("{}", str(here)) in one_line(result)
    assert not (here / "queue").exists()


def test_the_list_and_what_changes_it(here: Path) -> None:
    none = f"panolog: {here}/queue: has no queue yet; `panolog queue add` makes one"
    assert one_line(call("queue", "list")) == none
    for name in "abc":
        add(here, name)
    assert call("queue", "move", 3, "--first").exit_code == call("queue", "remove", 1).exit_code == 0
    assert call("queue", "list").stdout.splitlines() == [
        f"3  waiting      {here}/c",
        f"2  waiting      {here}/b",
        "no runner is at work: `panolog queue run` starts one",
    ]
    found = shown("queue", "list", "--all")
    assert (found["queue"], found["runner"]) == (str(here / "queue"), False)
    states = [(entry["id"], entry["state"]) for entry in found["entries"]]
    assert states == [(3, "waiting"), (1, "removed"), (2, "waiting")]
    assert found["entries"][0]["command"].startswith("panolog run /")
    line = "panolog: queue move: give one of --before ID, --first and --last"
    assert one_line(call("queue", "move", 2)) == line
    assert call("queue", "retry", 2).exit_code == 2


def test_a_queue_runs_the_program(here: Path) -> None:
    """Here one that is refused at once; what follows an end is proven in tests/orchestrator/runs/queue."""
    gone = write_scene(here / "gone")
    assert call("queue", "add", gone, "-o", here / "run").exit_code == 0
    shutil.rmtree(gone)
    ended = call("queue", "run")
    assert (ended.exit_code, ended.stdout) == (1, "")
    started, failed = ended.stderr.splitlines()
    assert started == f"panolog: started 1: {here}/run"
    assert failed.startswith(f"panolog: failed 1: {here}/run")
    assert f"{gone}: there is no such file or folder" in failed
