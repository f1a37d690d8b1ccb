"""Whole runs through Ray, undisturbed and killed at every stage: the result is the same to the byte."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunEnded, TaskStarted
from panolog.orchestrator.run.state import RunState, replay
from panolog.orchestrator.run.store import read_milestones, read_records
from panolog.scene.ply import ply_header
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, PLAN, TaskId
from tests.examples.test_examples import example

pytestmark = pytest.mark.system

SETTINGS = tuple(
    word
    for setting in (
        *("iterations=60", "sky.count=100", "checkpoint.every=20", "checkpoint.share=1"),
        *("device=cpu", "densify.start=10", "densify.every_floor=5"),
    )
    for word in ("--set", setting)
)

# A driver with accidents: after the first record of a kind and task it, or the worker, gets a signal.
# A worker that is to get one waits for it, however quick it is. In the merge the signal precedes the rename.
SCRIPT = """
import json, os, signal, sys, time
from dataclasses import dataclass, replace
from panolog.orchestrator.cli import app
from panolog.orchestrator.commands import session
from panolog.orchestrator.driver.driver import Driver
from panolog.workers import stopping
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.training.trainer import TrainSpec

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
accidents, workers = json.loads(sys.argv.pop(1)), {}

def strike(stored):
    for record in (item.record for item in stored):
        name, task = type(record).__name__, str(record.task)
        if name == "TaskStarted":
            workers[task] = record.pid
        if accidents and accidents[0][:2] == [name, task]:
            *_, victim, number = accidents.pop(0)
            if victim == "terminal":
                os.killpg(0, number)
            else:
                os.kill(workers[task] if victim == "worker" else os.getpid(), number)

def waiting(kind):
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Waiting(kind):
        awaited: str

        def run(self):
            for event in kind.run(self):
                yield event
                while type(event).__name__.startswith(self.awaited) and not stopping.requested():
                    time.sleep(0.01)

    return Waiting

WAITING = {kind: waiting(kind) for kind in (TrainSpec, EvaluateSpec)}

def wait(spec):
    kinds = {"CheckpointSaved": "Checkpoint", "PreviewSaved": "Preview", "ViewEvaluated": "Evaluated"}
    of_task = [(kind, victim) for kind, task, victim, _ in accidents if task == str(spec.task)]
    awaited = [kinds[kind] for kind, victim in of_task if victim != "driver"]
    return WAITING[type(spec)](**vars(spec), awaited=awaited[0]) if awaited else spec

def driver(job, journal, pool, hooks, stop):
    show = journal.on_change

    def on_change(state, stored):
        show(state, stored)
        strike(stored)

    journal.on_change = on_change
    return Driver(job, journal, pool, replace(hooks, on_start=wait), stop)

def merging(event, arguments):
    merged = event == "os.rename" and "point_cloud.ply" in str(arguments[1])
    if merged and accidents and accidents[0][0] == "merging":
        os.kill(os.getpid(), signal.SIGKILL)

session.Driver = driver
sys.addaudithook(merging)
app.main()
"""
Accident = tuple[str, str, str, int]
IN_STAGE_ONE: list[Accident] = [
    ("CheckpointSaved", "coarse", "worker", 9),
    ("CheckpointSaved", "coarse", "driver", 9),
]
IN_A_BLOCK: list[Accident] = [("CheckpointSaved", "block/000", "driver", 9)]
IN_THE_MERGE: list[Accident] = [("merging", "", "driver", 9)]
CTRL_C: list[Accident] = [("TaskStarted", "eval", "driver", 2)]


def launch(*arguments: object, accidents: list[Accident] | None = None) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SCRIPT, json.dumps(accidents or []), *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


@dataclass
class Ended:
    code: int
    stdout: str
    stderr: str


def end_of(process: subprocess.Popen[str]) -> Ended:
    stdout, stderr = process.communicate(timeout=300)
    return Ended(process.returncode, stdout, stderr)


def state_of(root: Path) -> RunState:
    return replay(read_milestones(RunFolder(root).database))


def wait_for_workers(root: Path) -> None:
    """Until no worker of the run is left; they die with their driver."""
    for stored in read_records(RunFolder(root).database):
        if isinstance(stored.record, TaskStarted) and psutil.pid_exists(stored.record.pid):
            psutil.Process(stored.record.pid).wait(60)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended, Path]:
    """An undisturbed run, what it said, and the folder of one that was killed in Stage I at the same time."""
    folder = tmp_path_factory.mktemp("recovery")
    scene = make_town(folder / "town", panoramas=9, width=64, points=300)
    calm, killed = folder / "calm", folder / "killed"
    processes = [
        launch("run", scene, "-o", calm, *SETTINGS),
        launch("run", scene, "-o", killed, *SETTINGS, accidents=IN_STAGE_ONE),
    ]
    calm_end, killed_end = map(end_of, processes)
    assert killed_end.code == -9, killed_end.stderr
    return calm, calm_end, killed


def test_a_run_says_where_everything_is_and_leaves_nothing_behind(runs: tuple[Path, Ended, Path]) -> None:
    root, end, _ = runs
    assert (end.code, end.stdout) == (0, ""), end.stderr
    assert "Traceback" not in end.stderr
    folder = RunFolder(root)
    for path in (folder.point_cloud, folder.metrics, folder.images, folder.plan_picture, folder.report):
        assert path.exists()
        assert str(path) in end.stderr
    report = json.loads(folder.metrics.read_text())
    count, sky = ply_header(folder.point_cloud)
    assert (report["gaussians"], report["bytes"], sky) == (count, folder.point_cloud.stat().st_size, 100)
    assert report["mean"]["psnr"] > 10
    assert report["mean"]["lpips"] is not None or report["lpips_reason"]
    wait_for_workers(root)
    assert not list(root.rglob("*.part"))


def test_a_run_killed_at_every_stage_ends_with_the_same_bytes(runs: tuple[Path, Ended, Path]) -> None:
    calm, _, killed = runs
    task = state_of(killed).task(COARSE)
    assert (task.retries, task.checkpoint) == (1, 40)
    wait_for_workers(killed)
    for accidents, done in ((IN_A_BLOCK, PLAN), (IN_THE_MERGE, TaskId.block(0))):
        end = end_of(launch("resume", killed, accidents=accidents))
        assert end.code == -9, end.stderr
        assert state_of(killed).status(done) == "done"
        assert not RunFolder(killed).point_cloud.exists()
        wait_for_workers(killed)
    assert list(killed.glob(".point_cloud.ply.*.part"))
    interrupted = end_of(launch("resume", killed, accidents=CTRL_C))
    assert (interrupted.code, interrupted.stdout) == (130, ""), interrupted.stderr
    assert "Traceback" not in interrupted.stderr
    assert state_of(killed).outcome == "interrupted"
    end = end_of(launch("resume", killed))
    assert end.code == 0, end.stderr
    ends = [s.record for s in read_records(RunFolder(killed).database) if isinstance(s.record, RunEnded)]
    assert [record.outcome for record in ends] == ["interrupted", "done"]
    assert not list(killed.rglob("*.part"))
    for name in ("coarse/model.ply", "blocks/000/model.ply", "blocks/001/model.ply", "point_cloud.ply"):
        assert (killed / name).read_bytes() == (calm / name).read_bytes(), name
    for name in ("partition/plan.json", "eval/seams.json", "eval/seams/000-001/merged.jpg"):
        assert (killed / name).read_bytes() == (calm / name).read_bytes(), name


def test_ctrl_c_leaves_fresh_checkpoints_and_a_limit_delivers_what_there_is(
    runs: tuple[Path, Ended, Path], tmp_path: Path
) -> None:
    """The whole foreground of a terminal gets the signal; without the limit the bytes are the same again."""
    calm, _, _ = runs
    root, prices = tmp_path / "run", tmp_path / "prices.toml"
    prices.write_text('currency = "EUR"\n[[machine]]\nname = "any"\nprice = 3600\nhost = "*"\n')
    more = ("--set", "checkpoint.every=1000", "--set", "preview.every=20", "--prices", prices)
    commands: dict[TaskId, tuple[object, ...]] = {
        COARSE: ("run", calm.parent / "town", "-o", root, *SETTINGS, *more),
        TaskId.block(1): ("resume", root),
    }
    for task, command in commands.items():
        end = end_of(launch(*command, accidents=[("PreviewSaved", str(task), "terminal", 2)]))
        assert (end.code, end.stdout) == (130, ""), end.stderr
        state = state_of(root)
        assert (state.outcome, state.task(task).retries) == ("interrupted", 0)
        assert 0 < (state.task(task).checkpoint or 0) < 60
    cost = state_of(root).money.used.cost
    assert cost > 0
    end = end_of(launch("resume", root, "--max-cost", cost * 1.001))  # which is used up by what follows
    assert (end.code, end.stdout) == (0, ""), end.stderr
    assert "ended early: the limit of" in end.stderr
    limited = state_of(root)
    assert (limited.outcome, limited.status(TaskId.block(1))) == ("limited", "waiting")
    assert limited.merged is not None
    assert (limited.metrics or {})["psnr"] is not None
    assert "<h2>Cost</h2>" in RunFolder(root).report.read_text()
    again = end_of(launch("resume", root))
    assert (again.code, state_of(root)) == (0, limited), again.stderr
    end = end_of(launch("resume", root, "--max-cost", "none"))
    assert (end.code, state_of(root).outcome) == (0, "done"), end.stderr
    assert (root / "point_cloud.ply").read_bytes() == (calm / "point_cloud.ply").read_bytes()


def call(*arguments: object) -> Any:
    """What a command prints as JSON."""
    result = CliRunner().invoke(app.app, [str(argument) for argument in (*arguments, "--json")])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def size(path: Path) -> tuple[int, ...]:
    return np.asarray(cv2.imread(str(path))).shape


def test_eval_reads_what_is_known_and_measures_what_is_not(runs: tuple[Path, Ended, Path]) -> None:
    root, _, _ = runs
    stored = json.loads(RunFolder(root).metrics.read_text())
    assert call("eval", root) == stored
    assert set(stored["views"]) == {"street_000.png", "street_008.png"}
    cropped = call("eval", root, "--crop-bottom", "0.25")
    assert cropped["mean"]["psnr"] != stored["mean"]["psnr"]
    coarse = call("eval", root, "--model", root / "coarse/model.ply")
    assert coarse["gaussians"] == ply_header(root / "coarse/model.ply")[0]
    assert json.loads(RunFolder(root).metrics.read_text()) == stored
    seams = RunFolder(root).seams.read_bytes()
    assert call("eval", root, "--seams") == stored | {"seams": json.loads(seams)}
    RunFolder(root).metrics.unlink()
    assert call("eval", root)["mean"] == pytest.approx(stored["mean"])
    RunFolder(root).seams.unlink()
    assert call("eval", root, "--seams")["seams"] == json.loads(seams)
    assert RunFolder(root).seams.read_bytes() == seams
    assert RunFolder(root).metrics.exists()


def test_a_plan_can_be_tried_without_training(runs: tuple[Path, Ended, Path], tmp_path: Path) -> None:
    root, _, _ = runs
    before = RunFolder(root).plan.read_bytes()
    plan = json.loads(before)
    assert call("partition", root) == plan
    position_only = call("partition", root, "--tau", "1")
    assert all(set(camera["assigned"]) == {str(camera["block"])} for camera in position_only["cameras"])
    other = call("partition", root, "--blocks", "1x3x1", "--rho", "2", "-o", tmp_path / "what-if")
    assert (other["grid"], other["rho_tri"], len(other["blocks"])) == ([1, 3, 1], 2, 3)
    assert {path.name for path in (tmp_path / "what-if/partition").iterdir()} == {
        "plan.json",
        "plan.png",
        "scores.npz",
    }
    again = call("partition", root, "--blocks", "2x1x1", "--rho", "5", "--tau", str(plan["tau_grad"]))
    assert again == plan
    assert RunFolder(root).plan.read_bytes() == before


def test_pictures_of_a_run_and_of_a_ply(runs: tuple[Path, Ended, Path], tmp_path: Path) -> None:
    root, _, _ = runs
    result = CliRunner().invoke(app.app, ["render", str(root), "-o", str(tmp_path / "tour"), "--path", "3"])
    assert result.exit_code == 0, result.output
    frames = sorted((tmp_path / "tour").iterdir())
    assert [size(frame) for frame in frames] == [(32, 64, 3)] * 3
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps([{"name": "a", "camera_to_world": np.eye(4).tolist()}]))
    options = ["--poses", str(poses), "--fov", "90", "--size", "40x30"]
    ply = str(root / "point_cloud.ply")
    result = CliRunner().invoke(app.app, ["render", ply, "-o", str(tmp_path / "views"), *options])
    assert result.exit_code == 0, result.output
    assert size(tmp_path / "views/a.png") == (30, 40, 3)


def test_a_finished_run_stays_finished(runs: tuple[Path, Ended, Path]) -> None:
    root, _, _ = runs
    assert call("status", root)["status"] == "done"
    history = len(read_records(RunFolder(root).database))
    result = CliRunner().invoke(app.app, ["resume", str(root)])
    assert result.exit_code == 0
    assert str(RunFolder(root).point_cloud) in result.stderr
    assert len(read_records(RunFolder(root).database)) == history


def test_the_example_without_ray_ends_with_the_same_bytes(
    runs: tuple[Path, Ended, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calm, _, _ = runs
    root = tmp_path / "run"
    example("run_without_ray")([str(calm.parent / "town"), str(root), *SETTINGS])
    assert "eval: EvaluationSaved" in capsys.readouterr().out
    assert state_of(root).outcome == "done"
    for name in ("coarse/model.ply", "blocks/001/model.ply", "point_cloud.ply", "partition/plan.json"):
        assert (root / name).read_bytes() == (calm / name).read_bytes(), name
