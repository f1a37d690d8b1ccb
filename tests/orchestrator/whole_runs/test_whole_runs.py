"""Whole runs through Ray with killed workers, and without Ray undisturbed: the same bytes."""

import json
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from subprocess import PIPE

import psutil
import pytest

from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import TaskStarted
from panolog.scene.ply import ply_header
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.examples.test_examples import example
from tests.orchestrator.cli.program import shown

pytestmark = pytest.mark.system

SETS: tuple[str, ...] = ("iterations=60", "sky.count=100", "checkpoint.every=20", "checkpoint.share=1")
SETS += ("device=cpu", "densify.start=10", "densify.every_floor=5")
SETTINGS = tuple(word for setting in SETS for word in ("--set", setting))

# A driver whose workers have accidents: after the first record of a kind and task its worker is killed. It
# waits for that, however quick it is.
SCRIPT = """
import json, os, sys
from dataclasses import dataclass, replace
from threading import Event
from panolog.orchestrator.cli import app
from panolog.orchestrator.cli.session import driving
from panolog.orchestrator.engine.driver.driver import Driver
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.training.trainer import TrainSpec

accidents, workers = json.loads(sys.argv.pop(1)), {}

def waiting(kind):
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Waiting(kind):
        def run(self):
            for event in kind.run(self):
                yield event
                if type(event).__name__.startswith(("Checkpoint", "Evaluated")):
                    Event().wait()

    return Waiting

WAITING = {kind: waiting(kind) for kind in (TrainSpec, EvaluateSpec)}

def wait(spec):
    doomed = str(spec.task) in [task for _, task in accidents]
    return WAITING[type(spec)](**vars(spec)) if doomed else spec

def driver(job, journal, pool, hooks, stop):
    show = journal.on_change

    def on_change(state, stored):
        show(state, stored)
        for record in (item.record for item in stored):
            name, task = type(record).__name__, str(record.task)
            if name == "TaskStarted":
                workers[task] = record.pid
            if accidents[:1] == [[name, task]]:
                del accidents[0]
                os.kill(workers[task], 9)

    journal.on_change = on_change
    return Driver(job, journal, pool, replace(hooks, on_start=wait), stop)

driving.Driver = driver
app.main()
"""
ACCIDENTS = (("CheckpointSaved", "coarse"), ("CheckpointSaved", "block/000"), ("ViewEvaluated", "eval"))


def wait_for_workers(root: Path) -> None:
    """Until no worker of the run is left; they die with their driver."""
    for stored in read_records(RunFolder(root).database):
        if isinstance(stored.record, TaskStarted) and psutil.pid_exists(stored.record.pid):
            psutil.Process(stored.record.pid).wait(60)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """The example without Ray, and a run through Ray whose workers were killed, with what that said."""
    folder = tmp_path_factory.mktemp("recovery")
    scene = make_town(folder / "town", panoramas=9, width=64, points=300)
    calm, killed = folder / "calm", folder / "killed"
    command = [sys.executable, "-c", SCRIPT, json.dumps(ACCIDENTS), "run", str(scene), "-o", str(killed)]
    command += SETTINGS
    with subprocess.Popen(command, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True) as process:
        with redirect_stdout(StringIO()) as said:
            example("run_without_ray")([str(scene), str(calm), *SETTINGS])
        stdout, stderr = process.communicate(timeout=300)
    assert (process.returncode, stdout) == (0, ""), stderr
    assert "eval: EvaluationSaved" in said.getvalue()
    return calm, killed, stderr


def test_a_run_says_where_everything_is_and_leaves_nothing_behind(runs: tuple[Path, Path, str]) -> None:
    _, root, said = runs
    assert "Traceback" not in said
    folder = RunFolder(root)
    for path in (folder.point_cloud, folder.metrics, folder.images, folder.plan_picture, folder.report):
        assert path.exists()
        assert str(path) in said
    report = json.loads(folder.metrics.read_text())
    count, sky = ply_header(folder.point_cloud)
    assert (report["gaussians"], report["bytes"], sky) == (count, folder.point_cloud.stat().st_size, 100)
    assert report["mean"]["psnr"] > 10
    assert report["mean"]["lpips"] is not None or report["lpips_reason"]
    wait_for_workers(root)
    assert not list(root.rglob("*.part"))


def test_a_run_whose_workers_are_killed_in_each_stage_ends_with_the_same_bytes(
    runs: tuple[Path, Path, str],
) -> None:
    calm, killed, _ = runs
    records = [stored.record for stored in read_records(RunFolder(killed).database)]
    starts = [record for record in records if isinstance(record, TaskStarted)]
    for task, iterations in ((COARSE, [0, 20]), (TaskId.block(0), [0, 20]), (EVAL, [0, 0])):
        assert [start.iteration for start in starts if start.task == task] == iterations
    names = ("coarse/model.ply", "blocks/000/model.ply", "blocks/001/model.ply", "point_cloud.ply")
    for name in (*names, "partition/plan.json", "eval/seams.json", "eval/seams/000-001/merged.jpg"):
        assert (killed / name).read_bytes() == (calm / name).read_bytes(), name


def test_eval_reads_what_is_known_and_measures_what_is_not(runs: tuple[Path, Path, str]) -> None:
    root, _, _ = runs
    stored = json.loads(RunFolder(root).metrics.read_text())
    assert shown("eval", root) == stored
    assert set(stored["views"]) == {"street_000.png", "street_008.png"}
    cropped = shown("eval", root, "--crop-bottom", "0.25")
    assert cropped["mean"]["psnr"] != stored["mean"]["psnr"]
    coarse = shown("eval", root, "--model", root / "coarse/model.ply")
    assert coarse["gaussians"] == ply_header(root / "coarse/model.ply")[0]
    assert json.loads(RunFolder(root).metrics.read_text()) == stored
    seams = RunFolder(root).seams.read_bytes()
    assert shown("eval", root, "--seams") == stored | {"seams": json.loads(seams)}
    RunFolder(root).metrics.unlink()
    assert shown("eval", root)["mean"] == pytest.approx(stored["mean"])
    RunFolder(root).seams.unlink()
    assert shown("eval", root, "--seams")["seams"] == json.loads(seams)
    assert RunFolder(root).seams.read_bytes() == seams
    assert RunFolder(root).metrics.exists()


def test_a_plan_can_be_tried_without_training(runs: tuple[Path, Path, str], tmp_path: Path) -> None:
    root, _, _ = runs
    before = RunFolder(root).plan.read_bytes()
    plan = json.loads(before)
    assert shown("partition", root) == plan
    position_only = shown("partition", root, "--tau", "1")
    assert all(set(camera["assigned"]) == {str(camera["block"])} for camera in position_only["cameras"])
    other = shown("partition", root, "--blocks", "1x3x1", "--rho", "2", "-o", tmp_path / "what-if")
    assert (other["grid"], other["rho_tri"], len(other["blocks"])) == ([1, 3, 1], 2, 3)
    assert {path.name for path in (tmp_path / "what-if/partition").iterdir()} == {
        "plan.json",
        "plan.png",
        "scores.npz",
    }
    again = shown("partition", root, "--blocks", "2x1x1", "--rho", "5", "--tau", str(plan["tau_grad"]))
    assert again == plan
    assert RunFolder(root).plan.read_bytes() == before
