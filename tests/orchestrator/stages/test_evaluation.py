"""What an evaluation keeps of the events of its task."""

from dataclasses import replace
from pathlib import Path

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.stages.evaluation import Evaluation
from panolog.scene.ply import write_ply
from panolog.workers.events import Evaluated, LeftOut, LpipsMissing, Notice, SeamMeasured
from panolog.workers.seams.schema import parse_seams
from panolog.workers.tasks import EVAL, TaskId
from panolog.workers.training.initialise import scene_gaussians
from tests.workers.seams.test_schema import FACES
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


def test_seams_are_written_with_their_pictures_and_count_for_completeness(tmp_path: Path) -> None:
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path / "run")
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    evaluation = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, folder, faces=1)
    evaluation.add(LeftOut(EVAL, "damaged", scene.panoramas[scene.test[0]].name))
    evaluation.add(LeftOut(EVAL, "damaged too", scene.panoramas[scene.train[0]].name))
    assert not evaluation.complete
    evaluation.add(SeamMeasured(EVAL, FACES[0], {"merged.jpg": b"a picture"}))
    assert evaluation.complete
    evaluation.save(folder)
    assert parse_seams(folder.seams.read_bytes()) == FACES[:1]
    assert (folder.seam(0, 1) / "merged.jpg").read_bytes() == b"a picture"
    assert list(evaluation.report()["left_out"].values()) == ["damaged"]


def test_without_faces_there_is_no_seams_json(tmp_path: Path) -> None:
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path / "run")
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, folder).save(folder)
    assert folder.metrics.exists() and not folder.seams.exists()


def test_what_is_measured_at_fitted_poses_stands_beside_the_metrics(tmp_path: Path) -> None:
    scene, folder = small_scene(tmp_path), RunFolder(tmp_path / "run")
    write_ply(tmp_path / "model.ply", scene_gaussians(scene))
    shards, whole = [TaskId.measure(0), TaskId.measure(1)], replace(scene, test=(3, 4))
    for shard, row in zip(shards, whole.test, strict=True):
        part = Evaluation(whole, tmp_path / "model.ply", WIDTH, 0.0, None, rows=(row,))
        there: dict[str, float | None] = {"psnr": 24.0 + row, "pixels": row / 2}
        part.add(Evaluated(shard, scene.panoramas[row].name, {"psnr": 20.0}, b"", there))
        part.save_shard(folder, shard)
    joined = Evaluation(whole, tmp_path / "model.ply", WIDTH, 0.0, None)
    joined.join(folder, shards)
    report = joined.report()
    assert report["mean"] == {"psnr": 20.0}
    assert report["pose_fit"]["mean"] == {"psnr": 27.5, "pixels": 1.75}
    assert report["pose_fit"]["views"]["pano_4.png"] == {"psnr": 28.0, "pixels": 2.0}
    plain = Evaluation(scene, tmp_path / "model.ply", WIDTH, 0.0, None)
    plain.add(Evaluated(EVAL, "pano_4.png", {"psnr": 20.0}, b""))
    assert "pose_fit" not in plain.report()
