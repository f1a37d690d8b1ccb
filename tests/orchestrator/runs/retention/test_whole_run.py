"""A run that is cleaned and damaged between its drivers ends with the same bytes, and stays readable."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.state import ignore, replay
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.events import Calibration, Checkpoint, Event, Trained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.calibrated import says
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.fakes import MACHINE, FakePool, trained, well
from tests.scenes import write_scene

pytestmark = pytest.mark.system

SETTINGS = ("sky.count=2", "width=64", "iterations=5", "device=cpu", "blocks=2x1x1")
KEPT = ("retention.checkpoints=3", "retention.models=false")


def pool(stop: TaskId | None = None) -> FakePool:
    """The colours of a model are brighter by the sum of the iterations that its checkpoints had.

    Args: stop, the task after whose third checkpoint the driver is interrupted.
    """

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        if not isinstance(spec, TrainSpec):
            yield from says(spec) if isinstance(spec, CalibrateSpec) else well(spec)
            return
        first = Checkpoint(spec.task, 0, {"sum": torch.zeros(1)})
        last = spec.checkpoint.load() if spec.checkpoint else first
        for iteration in range(last.iteration + 1, spec.iterations + 1):
            if (spec.task, iteration) == (stop, 4):
                raise KeyboardInterrupt
            last = Checkpoint(spec.task, iteration, {"sum": last.tensors["sum"] + iteration})
            yield last
        model = trained(spec)
        yield Trained(spec.task, replace(model, sh0=model.sh0 + last.tensors["sum"]), spec.iterations, 0.1)

    return FakePool(script, [MACHINE])


def panolog(*words: object) -> str:
    result = call(*words)
    assert result.exit_code == 0, result.stderr
    return result.stdout


def test_same_bytes_whatever_was_removed_in_between(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    calm, folder = RunFolder(tmp_path / "calm"), RunFolder(tmp_path / "run")
    session.start(scene, calm.root, load_config(None, SETTINGS), None, ignore, pool())
    assert calm.model(TaskId.block(0)).exists()
    config = load_config(None, (*SETTINGS, *KEPT))
    with pytest.raises(KeyboardInterrupt):
        session.start(scene, folder.root, config, None, ignore, pool(COARSE))
    assert len(folder.earlier_checkpoints(COARSE)) >= 2
    panolog("clean", folder.root, "--blocks", "--keep-checkpoints", 2)
    assert len(folder.earlier_checkpoints(COARSE)) == 1
    last = folder.checkpoint(COARSE)
    last.rename(last.with_name("damaged"))  # the bytes of a name that another one may share stay
    last.write_bytes(b"damaged")
    with pytest.raises(KeyboardInterrupt):
        session.resume(folder.root, None, ignore, pool(TaskId.block(0)))
    panolog("clean", folder.root, "--blocks")
    state = session.resume(folder.root, None, ignore, pool())
    damaged = "its last checkpoint is damaged: it continues from"
    assert any(notice.message.startswith(damaged) for notice in state.notices)
    assert folder.point_cloud.read_bytes() == calm.point_cloud.read_bytes()
    models = [folder.model(TaskId.block(number)) for number in range(2)]
    assert not any(path.exists() for path in models)  # its settings keep none
    panolog("clean", calm.root, "--blocks")
    assert not calm.model(TaskId.block(0)).exists()
    for run in (folder, calm):
        still_readable(run, tmp_path / f"{run.root.name}.spz")


def still_readable(run: RunFolder, exported: Path) -> None:
    assert json.loads(panolog("status", run.root, "--json"))["status"] == "done"
    panolog("report", run.root, "-o", exported.with_suffix(".html"))
    panolog("export", run.root, "-o", exported)
    panolog("partition", run.root, "--tau", "0.5", "--json")
    assert session.resume(run.root, None, ignore, pool()).outcome == "done"
    state = replay(read_milestones(run.database))
    assert sum("the models of the parts were removed" in it.message for it in state.notices) == 1
    refused = call("view", run.root, "--task", "block/001", "-o", exported.parent / "x")
    assert "the model of block/001 was removed after the merge" in one_line(refused)
