"""Exit codes and one clear line for everything a user can get wrong."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Noticed, Progressed, RunBegan, TaskStarted
from panolog.scene.errors import RunError
from panolog.workers.tasks import COARSE
from tests.orchestrator.calibrated import says
from tests.orchestrator.cli.program import call, finished, one_line, shown
from tests.orchestrator.fakes import FakePool
from tests.orchestrator.history import begun
from tests.orchestrator.watch.views.comparison.runs import metrics, write


@pytest.fixture
def run(tmp_path: Path) -> Path:
    records = RunBegan("host", 1, resumed=False), TaskStarted(COARSE, 1, 0, "node", 2, "cpu", 2)
    more = Progressed(COARSE, 5, 10, 2.0, loss=0.25), Noticed(COARSE, "a.jpg is left out")
    return begun(tmp_path / "run", *records, *more).root


def calibrated(monkeypatch: pytest.MonkeyPatch, memory: int) -> None:
    """A machine with so many bytes of memory instead of this one, and a calibration that is made up."""

    @contextmanager
    def connect(_: object, __: object, ___: object, meanwhile: Callable[[], None]) -> Iterator[FakePool]:
        meanwhile()
        yield FakePool(says, [Node("node", "host", 2, memory)])

    monkeypatch.setattr("panolog.orchestrator.engine.cluster.connection.connect", connect)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--set", "sky.cuont=3"), "did you mean sky.count?"),
        (("--config", "/nowhere.yaml"), "/nowhere.yaml: cannot be read"),
        (("--width", "4096"), "the panoramas have 64 pixels"),
        (("--address", "127.0.0.1:1"), "no Ray cluster answers there"),
        (("--address", "nowhere"), "write auto or HOST:PORT"),
    ],
)
def test_wrong_options(scene: Path, tmp_path: Path, arguments: tuple[str, ...], expected: str) -> None:
    assert expected in one_line(call("run", scene, "-o", tmp_path / "run", *arguments))
    assert not (tmp_path / "run").exists()


def test_folders_that_are_no_run_and_no_scene(tmp_path: Path) -> None:
    for command in ("status", "resume", "events", "eval", "partition"):
        assert "is not a run folder" in one_line(call(command, tmp_path))
    wanted = "give a scene, a folder of panoramas or a 360° video"
    none = one_line(call("run", tmp_path / "none", "-o", tmp_path / "run"))
    assert none == f"panolog: {tmp_path / 'none'}: there is no such file or folder; {wanted}"
    (tmp_path / "empty").mkdir()
    empty = one_line(call("run", tmp_path / "empty", "-o", tmp_path / "run"))
    assert empty == f"panolog: {tmp_path / 'empty'}: the folder is empty; {wanted}"
    assert "no such folder" in one_line(call("scene", "info", tmp_path / "none"))
    assert "`panolog run` makes one of panoramas" in one_line(call("scene", "info", tmp_path / "empty"))


def test_what_cannot_be_done_yet(run: Path, tmp_path: Path) -> None:
    assert "point_cloud.ply: does not exist yet" in one_line(call("eval", run))
    assert "Stage I has not ended" in one_line(call("partition", run))
    assert "no merged model yet" in one_line(call("render", run, "-o", tmp_path / "out", "--path", "3"))
    assert "there is no such folder" in one_line(call("resume", run))


def test_what_the_system_refuses_is_one_line(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = finished(tmp_path / "finished", scene)

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied", "/root/runs")

    monkeypatch.setattr("panolog.orchestrator.cli.commands.repartition.write_plan", refuse)
    out = tmp_path / "out"
    line = "panolog: /root/runs: Permission denied"
    assert one_line(call("partition", root, "--tau", "1", "-o", out)) == line
    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", refuse)
    assert one_line(call("run", scene, "-o", out)) == line


def test_usage_errors_exit_with_two() -> None:
    for words in (("run",), ("nonsense",), ("status", "a", "--nope")):
        assert call(*words).exit_code == 2
    assert call("--help").exit_code == 0
    number = call("run", "a", "-o", "b", "--width", "abc")
    assert number.exit_code == 2 and "'--width': write a whole number" in number.stderr
    assert "must be less than or equal to 19" in call("run", "a", "-o", "b", "--nice", "40").stderr


def test_the_help_of_run_begins_with_the_basic_options() -> None:
    basics, *_ = call("run", "--help").stdout.split("─ Options ─")[1].split("\n╭─ ")
    names = ("output", "blocks", "iterations", "width", "device", "help")
    assert re.findall(r" --[a-z]+", basics) == [f" --{name}" for name in names]
    result = call("--version")
    assert (result.exit_code, result.stdout) == (0, f"panolog {version('panolog')}\n")


def test_a_failed_and_an_interrupted_run(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RunError("block 3 failed")

    def interrupt(_: object, root: Path, *rest: object) -> None:
        begun(root)
        raise KeyboardInterrupt

    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", fail)
    failed = call("run", scene, "-o", tmp_path / "run")
    assert (failed.exit_code, failed.stderr) == (1, "panolog: block 3 failed\n")
    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", interrupt)
    root = tmp_path / "my run"
    interrupted = call("run", scene, "-o", root)
    assert interrupted.exit_code == 130
    assert interrupted.stderr == f"panolog: stopped; `panolog resume '{root}'` resumes the run\n"


def test_status_and_events_of_a_dead_run(run: Path) -> None:
    found = shown("status", run)
    assert (found["status"], found["stage"], found["width"]) == ("stopped", "coarse", 64)
    expected = {"iteration": 5, "loss": 0.25, "status": "waiting", "eta": None}
    assert found["tasks"][0] | expected == found["tasks"][0]
    text = call("status", run).stdout
    said = ("driver lost", "process 1 on host, was killed", f"`panolog resume {run}` resumes it", "5/10")
    assert all(words in text for words in said)
    for option in ((), ("--follow",)):
        lines = [json.loads(line) for line in call("events", run, *option).stdout.splitlines()]
        assert [line["type"] for line in lines] == ["RunBegan", "TaskStarted", "Progressed", "Noticed"]


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"")])
def test_a_run_killed_before_its_database_was_made(run: Path, damage: Callable[[Path], None]) -> None:
    damage(run / "run.db")
    assert shown("status", run)["tasks"] == []
    events = call("events", run)
    assert (events.exit_code, events.stdout) == (0, "")
    assert "there is no such folder" in one_line(call("resume", run))  # it looks for the scene


def test_a_plan_that_is_tried_says_what_it_needs_and_where_it_is(
    scene: Path, run: Path, tmp_path: Path
) -> None:
    root = finished(tmp_path / "finished", scene)
    result = call("partition", root, "--tau", "1", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert re.search(r"^Stage II on this machine: .*GiB of memory, (about|time)", result.stdout, re.MULTILINE)
    assert result.stdout.endswith(f"written to {tmp_path / 'out' / 'partition'}\n")
    assert RunFolder(tmp_path / "out").plan_picture.read_bytes().startswith(b"\x89PNG")
    end = "not written; give --output FOLDER to keep it\n"
    assert call("partition", root, "--tau", "1").stdout.endswith(end)
    for output in (run, root):
        assert "is a run" in one_line(call("partition", root, "-o", output))
    assert not (run / "partition").exists()


def test_a_changed_scene_is_refused_by_all_that_read_it(scene: Path, tmp_path: Path) -> None:
    root = finished(tmp_path / "changed", scene, "of another scene")
    for command in ("resume", "eval", "partition"):
        assert "the scene has changed" in one_line(call(command, root))
    rendered = call("render", root, "--path", "3", "-o", tmp_path / "out")
    assert "the scene has changed" in one_line(rendered)


def test_scene_info_and_doctor(scene: Path) -> None:
    found = shown("scene", "info", scene)
    assert (found["panoramas"], found["width"], found["points"]) == (9, 64, 50)
    assert "9 panoramas of 64x32" in call("scene", "info", scene).stdout
    assert "torch" in call("doctor").stdout


@pytest.mark.parametrize(("memory", "code", "place"), [(2**40, 0, ""), (2**20, 2, ""), (2**40, 0, "file://")])
def test_doctor_tells_what_a_job_needs_and_whether_it_fits(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, memory: int, code: int, place: str
) -> None:
    calibrated(monkeypatch, memory)
    monkeypatch.setenv("PANOLOG_STORE_CACHE", str(tmp_path / "cache"))
    doctored = call("doctor", f"{place}{scene}", "--json", "--iterations", 100, "--blocks", "2x1x1")
    assert doctored.exit_code == code
    found = json.loads(doctored.stdout)
    assert found["ready"] == (code == 0)
    assert any(finding["what"] == "disk of the job" for finding in found["findings"])
    stages = {stage["name"]: stage for stage in found["preflight"]["estimate"]["stages"]}
    assert list(stages) == ["coarse", "score", "block", "union", "repair", "merge", "eval", "deliver"]
    assert stages["block"]["tasks"] == 2
    assert found["preflight"]["estimate"]["seconds"] > 0
    assert (found["preflight"]["problem"] is None) == (code == 0)


def test_doctor_says_that_the_compiled_core_is_missing() -> None:
    script = (
        "import importlib.util, sys\n"
        "sys.modules['panolog.renderer._core'] = None\n"  # an import of it fails
        "found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name: None if name.endswith('._core') else found(name)\n"
        "from panolog.orchestrator.cli.app import app\n"
        "app(['doctor'])"
    )
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    progress = [line for line in ended.stderr.splitlines() if line.startswith("checking this machine")]
    assert (ended.returncode, ended.stderr.splitlines()) == (2, progress)  # on a slow machine there is some
    assert "MISSING compiled core" in ended.stdout


def test_what_only_reads_imports_neither_torch_nor_ray(run: Path, tmp_path: Path) -> None:
    """One process executes each command that users wait for, and none may import what takes seconds."""
    others = [str(write(tmp_path / name, measured=metrics()).root) for name in ("one", "other")]
    commands = [["--help"], ["status", str(run)], ["events", str(run)], ["compare", *others]]
    script = (
        "import sys\nfrom panolog.orchestrator.cli.app import app\n"
        "import panolog.orchestrator.runs.queue.view\n"
        "assert 'pydantic' not in sys.modules\n"
        "import panolog.orchestrator.cli.session.supervise\n"
        f"for command in {commands!r}:\n"
        "    app(command, standalone_mode=False)\n"
        "    slow = {'torch', 'ray', 'cv2', 'scipy.sparse', 'scipy.spatial'} & set(sys.modules)\n"
        "    assert not slow, (command, slow)\n"
        "import panolog.orchestrator.cli.session.session, panolog.orchestrator.engine.cluster.connection\n"
        "assert 'torch' not in sys.modules"  # before it shows its place
    )
    ended = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
