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
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner, Result

from panolog.orchestrator.cli import app
from panolog.orchestrator.resources.nodes import Node
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import SceneRef, make_info, write_info
from panolog.orchestrator.run.records import Noticed, Progressed, RunBegan, TaskStarted
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError
from panolog.scene.ply import write_ply
from panolog.scene.read import read_scene
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import scene_gaussians
from tests.orchestrator.calibrated import says
from tests.orchestrator.fakes import FakePool
from tests.orchestrator.messages import without_progress
from tests.scenes import write_scene


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app.app, [str(argument) for argument in arguments])


STEPS = ("starting Ray", "connecting to the cluster", "measuring exposures", "calibrating")  # of a preflight


def one_line(result: Result) -> str:
    assert result.exit_code == 2, result.output
    lines = [line for line in without_progress(result.stderr) if line not in STEPS]
    assert len(lines) == 1, result.stderr
    assert result.stdout == ""
    return lines[0]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = RunFolder(tmp_path / "run")
    folder.root.mkdir()
    write_info(folder, make_info(SceneRef(path="/gone", fingerprint="f"), RunConfig(width=64)))
    database = Database(folder.database)
    database.append([RunBegan("host", 1, resumed=False), TaskStarted(COARSE, 1, 0, "node", 2, "cpu", 2)])
    database.append([Progressed(COARSE, 5, 10, 2.0, loss=0.25), Noticed(COARSE, "a.jpg is left out")])
    database.close()
    return folder.root


def calibrated(monkeypatch: pytest.MonkeyPatch, memory: int) -> None:
    """A machine with so many bytes of memory instead of this one, and a calibration that is made up."""

    @contextmanager
    def connect(*_: object) -> Iterator[FakePool]:
        yield FakePool(says, [Node("node", "host", 2, memory)])

    monkeypatch.setattr("panolog.orchestrator.cluster.connection.connect", connect)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--blocks", "0x1x1"), 'setting blocks = "0x1x1"'),
        (("--set", "sky.cuont=3"), "did you mean sky.count?"),
        (("--config", "/nowhere.yaml"), "/nowhere.yaml: cannot be read"),
        (("--width", "4096"), "the panoramas have 64 pixels"),
        (("--device", "tpu"), 'setting device = "tpu"'),
        (("--iterations", "0"), "setting iterations = 0"),
        (("--address", "127.0.0.1:1"), "no Ray cluster answers there"),
        (("--address", "nowhere"), "write auto or HOST:PORT"),
    ],
)
def test_wrong_options(scene: Path, tmp_path: Path, arguments: tuple[str, ...], expected: str) -> None:
    assert expected in one_line(call("run", scene, "-o", tmp_path / "run", *arguments))
    assert not (tmp_path / "run").exists()


def test_a_missing_scene(tmp_path: Path) -> None:
    assert "no such folder" in one_line(call("run", tmp_path / "none", "-o", tmp_path / "run"))
    assert "no such folder" in one_line(call("scene", "info", tmp_path / "none"))


def test_an_output_of_another_scene_stays_untouched(scene: Path, run: Path) -> None:
    before = {path: path.read_bytes() for path in run.iterdir()}
    assert "another scene" in one_line(call("run", scene, "-o", run))
    assert {path: path.read_bytes() for path in run.iterdir()} == before


def test_no_disk_space_for_checkpoints(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        free = 1000

    monkeypatch.setattr("shutil.disk_usage", lambda _: Full)
    calibrated(monkeypatch, memory=2**40)
    assert "of its disk are free" in one_line(call("run", scene, "-o", tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", [("status",), ("resume",), ("events",), ("eval",), ("partition",)])
def test_a_folder_that_is_no_run(tmp_path: Path, command: tuple[str, ...]) -> None:
    assert "is not a run folder" in one_line(call(*command, tmp_path))


def test_what_cannot_be_done_yet(run: Path, tmp_path: Path) -> None:
    assert "point_cloud.ply: does not exist yet" in one_line(call("eval", run))
    assert "Stage I has not ended" in one_line(call("partition", run))
    assert "no merged model yet" in one_line(call("render", run, "-o", tmp_path / "out", "--path", "3"))
    assert "there is no such folder" in one_line(call("resume", run))


def test_wrong_ways_to_render(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert "neither a run nor a PLY" in one_line(call("render", tmp_path / "x.ply", "-o", out, "--path", "3"))
    assert "must be even" in one_line(call("render", run, "-o", out, "--path", "3", "--width", "33"))
    assert "like 1280x720" in one_line(call("render", run, "-o", out, "--fov", "90", "--size", "big"))
    wide = one_line(call("render", run, "-o", out, "--fov", "200"))
    assert wide == "panolog: --fov 200: the field of view is 200 degrees, must be above 0 and below 180"
    assert "give --mp4 too" in one_line(call("render", run, "-o", out, "--fps", "30"))
    assert "at most 32766" in one_line(call("render", run, "-o", out, "--fov", "90", "--size", "40000x20"))
    for option in (("--size", "8x8"), ("--yaw", "0"), ("--pitch", "3")):
        assert "give --fov too" in one_line(call("render", run, "-o", out, *option))
    assert "give --size" in one_line(call("render", run, "-o", out, "--fov", "90", "--width", "64"))
    assert not out.exists()


def test_what_the_system_refuses_is_one_line(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = finished(tmp_path / "finished", scene, read_scene(scene).fingerprint)

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied", "/root/runs")

    monkeypatch.setattr("panolog.orchestrator.commands.repartition.write_plan", refuse)
    out = tmp_path / "out"
    assert (
        one_line(call("partition", root, "--tau", "1", "-o", out)) == "panolog: /root/runs: Permission denied"
    )
    monkeypatch.setattr("panolog.orchestrator.commands.session.start", refuse)
    assert "Permission denied" in one_line(call("run", scene, "-o", out))


def test_where_a_demo_cannot_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "thesis.txt").touch()
    monkeypatch.chdir(tmp_path / "here")
    assert "is not empty" in one_line(call("demo", "-o", "."))
    assert "cannot be written next to it" in one_line(call("demo", "-o", "/"))
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def test_a_town_whose_making_was_cut_off_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []
    monkeypatch.setattr(
        "panolog.orchestrator.commands.demo.make_town", lambda town, progress: made.append(town)
    )
    monkeypatch.setattr("panolog.orchestrator.commands.session.start", lambda *_: None)
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    model = tmp_path / "run-town" / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.bin").touch()
    assert call("demo", "-o", tmp_path / "run").exit_code == 0
    (model / "points3D.bin").touch()
    assert call("demo", "-o", tmp_path / "run").exit_code == 0
    assert made == [tmp_path / "run-town"]


def test_a_flight_is_made_next_to_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[Path] = []
    started: list[tuple[Path, Path]] = []
    monkeypatch.setattr(
        "panolog.orchestrator.commands.demo.make_flight", lambda folder, **_: made.append(folder)
    )
    monkeypatch.setattr(
        "panolog.orchestrator.commands.session.start", lambda scene, root, *_: started.append((scene, root))
    )
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    assert call("demo", "--flight").exit_code == 0
    scene = tmp_path / "runs" / "flight-district"
    assert (made, started) == ([scene], [(scene, Path("runs/flight"))])


def test_a_run_of_the_town_is_not_taken_for_a_flight(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    reference = SceneRef(path=str(tmp_path / "run-town"), fingerprint="f")
    write_info(RunFolder(tmp_path / "run"), make_info(reference, RunConfig(width=64)))
    assert "a run of another scene" in one_line(call("demo", "--flight", "-o", tmp_path / "run"))
    assert "a run of another scene" in one_line(call("demo", "--city", "9", "-o", tmp_path / "run"))


def test_a_city_has_a_scene_for_each_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[tuple[Path, int, bool]] = []
    monkeypatch.setattr(
        "panolog.orchestrator.commands.demo.make_city",
        lambda folder, panoramas, flight, **_: made.append((folder, panoramas, flight)),
    )
    started: list[str] = []
    monkeypatch.setattr(
        "panolog.orchestrator.commands.session.start",
        lambda scene, root, config, *_: started.append(f"{config.recipe} {config.blocks}"),
    )
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    assert call("demo", "--city", "300").exit_code == 0
    assert call("demo", "--city", "20", "--flight").exit_code == 0
    runs = tmp_path / "runs"
    assert made == [(runs / "city-city-300", 300, False), (runs / "city-city-20-flight", 20, True)]
    assert started == ["panolog 7", "panolog 2"]
    assert call("demo", "--city", "1").exit_code == 2


def test_usage_errors_exit_with_two() -> None:
    assert call("run").exit_code == 2
    assert call("nonsense").exit_code == 2
    assert call("status", "a", "--nope").exit_code == 2
    assert call("--help").exit_code == 0


def test_a_failed_and_an_interrupted_run(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RunError("block 3 failed")

    def interrupt(_: object, root: Path, *rest: object) -> None:
        root.mkdir()
        write_info(RunFolder(root), make_info(SceneRef(path="/gone", fingerprint="f"), RunConfig(width=64)))
        raise KeyboardInterrupt

    monkeypatch.setattr("panolog.orchestrator.commands.session.start", fail)
    failed = call("run", scene, "-o", tmp_path / "run")
    assert (failed.exit_code, failed.stderr) == (1, "panolog: block 3 failed\n")
    monkeypatch.setattr("panolog.orchestrator.commands.session.start", interrupt)
    root = tmp_path / "my run"
    interrupted = call("run", scene, "-o", root)
    assert interrupted.exit_code == 130
    assert interrupted.stderr == f"panolog: stopped; `panolog resume '{root}'` resumes the run\n"


def test_status_reads_a_dead_run(run: Path) -> None:
    shown = json.loads(call("status", run, "--json").stdout)
    assert (shown["status"], shown["stage"], shown["width"]) == ("stopped", "coarse", 64)
    assert (
        shown["tasks"][0] | {"iteration": 5, "loss": 0.25, "status": "waiting", "eta": None}
        == shown["tasks"][0]
    )
    text = call("status", run).stdout
    assert "driver lost" in text
    assert "process 1 on host, was killed" in text
    assert f"`panolog resume {run}` resumes it" in text
    assert "5/10" in text


def test_events_are_json_lines(run: Path) -> None:
    for option in ((), ("--follow",)):
        lines = [json.loads(line) for line in call("events", run, *option).stdout.splitlines()]
        assert [line["type"] for line in lines] == ["RunBegan", "TaskStarted", "Progressed", "Noticed"]


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"")])
def test_a_run_killed_before_its_database_was_made(run: Path, damage: Callable[[Path], None]) -> None:
    damage(run / "run.db")
    assert json.loads(call("status", run, "--json").stdout)["tasks"] == []
    shown = call("events", run)
    assert (shown.exit_code, shown.stdout) == (0, "")
    assert "there is no such folder" in one_line(call("resume", run))  # it looks for the scene


def finished(root: Path, scene: Path, fingerprint: str) -> Path:
    """A run folder with both models, of a scene with that fingerprint."""
    folder = RunFolder(root)
    folder.of(COARSE).mkdir(parents=True)
    write_info(folder, make_info(SceneRef(path=str(scene), fingerprint=fingerprint), RunConfig(width=64)))
    model = scene_gaussians(read_scene(scene))
    for path in (folder.model(COARSE), folder.point_cloud):
        write_ply(path, model)
    return root


def test_a_plan_that_is_tried_says_what_it_needs_and_where_it_is(scene: Path, tmp_path: Path) -> None:
    root = finished(tmp_path / "run", scene, read_scene(scene).fingerprint)
    result = call("partition", root, "--tau", "1", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert re.search(r"^Stage II on this machine: .*GiB of memory, (about|time)", result.stdout, re.MULTILINE)
    assert result.stdout.endswith(f"written to {tmp_path / 'out' / 'partition'}\n")
    assert call("partition", root, "--tau", "1").stdout.endswith(
        "not written; give --output FOLDER to keep it\n"
    )


@pytest.mark.parametrize(
    "command", [("resume",), ("eval",), ("partition",), ("render", "--path", "3", "-o", "out")]
)
def test_a_changed_scene_is_refused_by_all_that_read_it(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    root = finished(tmp_path / "changed", scene, "of another scene")
    name, *options = command
    assert "the scene has changed" in one_line(call(name, root, *options))


def test_a_what_if_does_not_go_into_a_run(scene: Path, run: Path, tmp_path: Path) -> None:
    root = finished(tmp_path / "finished", scene, read_scene(scene).fingerprint)
    for output in (run, root):
        assert "is a run" in one_line(call("partition", root, "-o", output))
    assert not (run / "partition").exists()


def test_scene_info_and_doctor(scene: Path) -> None:
    shown = json.loads(call("scene", "info", scene, "--json").stdout)
    assert (shown["panoramas"], shown["width"], shown["points"]) == (9, 64, 50)
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
    shown = json.loads(doctored.stdout)
    assert shown["ready"] == (code == 0)
    assert any(finding["what"] == "disk of the job" for finding in shown["findings"])
    stages = {stage["name"]: stage for stage in shown["preflight"]["estimate"]["stages"]}
    assert list(stages) == ["coarse", "score", "block", "union", "repair", "merge", "eval", "deliver"]
    assert stages["block"]["tasks"] == 2
    assert shown["preflight"]["estimate"]["seconds"] > 0
    assert (shown["preflight"]["problem"] is None) == (code == 0)


def test_doctor_says_that_the_compiled_core_is_missing() -> None:
    script = (
        "import importlib.util, sys\n"
        "sys.modules['panolog.renderer._core'] = None\n"  # an import of it fails
        "found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name: None if name.endswith('._core') else found(name)\n"
        "from panolog.orchestrator.cli.app import app\n"
        "app(['doctor'])"
    )
    shown = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    progress = [line for line in shown.stderr.splitlines() if line.startswith("checking this machine")]
    assert (shown.returncode, shown.stderr.splitlines()) == (2, progress)  # on a slow machine there is some
    assert "MISSING compiled core" in shown.stdout


@pytest.mark.parametrize(("arguments", "count"), [(["status"], 2), (["events"], 2), (["--help"], 1)])
def test_what_only_reads_imports_neither_torch_nor_ray(run: Path, arguments: list[str], count: int) -> None:
    script = (
        "import sys; from panolog.orchestrator.cli.app import app\n"
        f"app([*{arguments!r}, {str(run)!r}][:{count}], standalone_mode=False)\n"
        "assert not {'torch', 'ray'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_the_commands_are_those_of_the_contract() -> None:
    program = get_command(app.app)
    assert isinstance(program, TyperGroup)
    running = {"run", "resume", "stop", "pause", "unpause", "retry", "release", "demo"}
    reading = {"status", "events", "eval", "render", "partition", "view", "report", "dashboard", "doctor"}
    reading |= {"compare", "export"}
    assert program.commands.keys() == running | reading | {"clean", "scene", "cluster", "notify", "queue"}
    groups = {name: group for name, group in program.commands.items() if isinstance(group, TyperGroup)}
    assert list(groups["cluster"].commands) == ["submit", "resume", "status", "stop", "leave"]
    assert list(groups["notify"].commands) == ["test"]
    assert list(groups["queue"].commands) == ["add", "list", "move", "remove", "retry", "run"]
    assert set(groups["scene"].commands) == {"info", "check", "import", "sfm", "mask", "depth"}


def test_the_version() -> None:
    result = call("--version")
    assert (result.exit_code, result.stdout) == (0, f"panolog {version('panolog')}\n")
