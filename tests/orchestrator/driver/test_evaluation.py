"""What an evaluation keeps of the events of its task."""

from pathlib import Path

from panolog.orchestrator.driver.evaluation import Evaluation
from panolog.scene.ply import write_ply
from panolog.workers.events import LpipsMissing, Notice
from panolog.workers.tasks import EVAL
from panolog.workers.training.initialise import scene_gaussians
from tests.workers.small import WIDTH, small_scene


def test_only_missing_lpips_is_the_reason_for_missing_lpips(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    evaluation = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, None)
    evaluation.add(Notice(EVAL, "a panorama was read twice"))
    assert evaluation.report()["lpips_reason"] is None
    evaluation.add(LpipsMissing(EVAL, "lpips is not installed"))
    evaluation.add(Notice(EVAL, "a panorama was read twice"))
    assert evaluation.report()["lpips_reason"] == "lpips is not installed"
