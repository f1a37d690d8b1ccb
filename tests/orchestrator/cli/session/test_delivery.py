"""A run ends with files for viewers."""

import json
from pathlib import Path

import pytest

from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.records import Delivered, Noticed
from panolog.scene.ply import read_ply, read_sky
from panolog.workers.tasks import DELIVER, EVAL
from tests.orchestrator.fakes import Harness


def delivering(folder: Path) -> Harness:
    """A run with run.json, which names the scene."""
    harness = Harness(folder, deliver=True)
    scene = harness.job.scene
    reference = SceneRef(path=str(scene.root), fingerprint=scene.fingerprint)
    write_info(harness.folder, make_info(reference, harness.job.config))
    return harness


def test_files_for_viewers(tmp_path: Path) -> None:
    harness = delivering(tmp_path)
    state = harness.drive()
    assert state.outcome == "done"
    folder, (record,) = harness.folder, harness.records(Delivered)
    whole = read_ply(folder.point_cloud)
    sky = read_ply(folder.sky)
    assert (len(sky), sky.sky) == (whole.sky, whole.sky)
    assert (sky.means == read_sky(folder.point_cloud).means).all()
    place = json.loads(folder.georeference.read_bytes())
    assert place["provenance"]["scene"] == harness.job.scene.fingerprint
    assert place["provenance"]["settings"]["width"] == harness.job.config.width
    page = json.loads((folder.web / "scene.json").read_bytes())
    assert page["total"] == len(whole)
    assert [camera["name"] for camera in page["cameras"]]
    assert (folder.web / page["model"]).is_file() and (folder.web / "index.html").is_file()
    files = [folder.sky, folder.georeference, folder.page, *folder.web.rglob("*")]
    assert b"engine.js" in folder.page.read_bytes()
    assert record.size == sum(file.stat().st_size for file in files if file.is_file())
    assert state.task(DELIVER).status == "done"


def test_a_resumed_run_has_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    whole, killed = delivering(tmp_path / "a"), delivering(tmp_path / "b")
    whole.drive()

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("panolog.orchestrator.cli.session.delivery.write_json", die)
        with pytest.raises(KeyboardInterrupt):
            killed.drive()
    assert killed.state.task(EVAL).status == "done" != killed.state.task(DELIVER).status
    assert killed.drive(resumed=True).outcome == "done"
    for name in ("web/scene.json", "web/model.sog", "sky.ply"):
        assert (whole.folder.root / name).read_bytes() == (killed.folder.root / name).read_bytes()


def test_a_place_that_is_wrong_is_a_notice(tmp_path: Path) -> None:
    harness = delivering(tmp_path)
    (harness.job.scene.root / "offset.json").write_text("{}")
    assert harness.drive().outcome == "done"
    (notice,) = (record for record in harness.records(Noticed) if record.task == DELIVER)
    assert "no files for viewers" in notice.message and "offset.json: offset" in notice.message
    assert not harness.folder.web.exists()
