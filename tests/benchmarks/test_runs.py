"""Runs that benchmarks begin with the Stage I of another."""

from pathlib import Path

import pytest

from benchmarks.runs import borrow_stage_one
from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome, TaskStarted
from panolog.orchestrator.runs.state import ignore
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.tasks import COARSE, Stage
from tests.orchestrator.calibrated import says
from tests.orchestrator.fakes import MACHINE, FakePool, well
from tests.scenes import write_scene

pytestmark = pytest.mark.system


def test_a_run_trains_no_coarse_model_again_that_another_has(tmp_path: Path) -> None:
    """A database with the records of a model, but of no driver, is not taken for one that is lost."""
    scene, donor, root = write_scene(tmp_path / "scene"), tmp_path / "donor", tmp_path / "run"
    config = load_config(flags={"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2})
    pool = FakePool(lambda spec: says(spec) if isinstance(spec, CalibrateSpec) else well(spec), [MACHINE])
    session.start(scene, donor, config, None, ignore, pool)
    borrow_stage_one(donor, root, {"partition.tau_grad": 1.0}, scores=False)
    assert session.resume(root, None, ignore, pool).outcome == Outcome.DONE
    started = [
        item.record.task
        for item in read_records(RunFolder(root).database)
        if isinstance(item.record, TaskStarted)
    ]
    assert started.count(COARSE) == 1
    assert any(task.stage is Stage.BLOCK for task in started)
