"""From another program's files to a model: import, run, PLY."""

from contextlib import closing
from pathlib import Path

import pytest
import torch

from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.store import Database
from panolog.prepare.importers.import_scene import import_scene
from panolog.scene.ply import read_ply
from panolog.scene.read import read_scene
from tests.orchestrator.fakes import MACHINE, FakePool
from tests.prepare.importers.writers import WRITERS

pytestmark = pytest.mark.system

# All formats give the same scene (tests/prepare/importers/test_same_scene.py); these differ in tracks, split
# and layout.
CASES = ("opensfm", "360roam", "panorama_sfm", "nerfstudio")


@pytest.mark.parametrize("case", CASES)
def test_run_after_import(case: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "panolog")
    _, source = WRITERS[case][1](tmp_path / "source")
    import_scene(source, tmp_path / "scene")
    scene, folder = read_scene(tmp_path / "scene"), RunFolder(tmp_path / "run")
    folder.root.mkdir()
    config = RunConfig.model_validate(
        {"width": scene.width, "device": "cpu", "iterations": 4, "blocks": "2x1x1", "sky": {"count": 10}}
    )
    with closing(Database(folder.database)) as database:
        job, pool = Job(folder, scene, config), FakePool(lambda spec: spec.run(), [MACHINE])
        state = Driver(job, Journal(database), pool).run()
    assert state.outcome == "done"
    assert "coarse: attempt 1 from iteration 0 on node" in caplog.text
    assert "Gaussians from iteration 0 of 4" in caplog.text
    model = read_ply(folder.point_cloud)
    assert len(model) > 10
    assert all(bool(torch.isfinite(tensor).all()) for tensor in model.tensors().values())
