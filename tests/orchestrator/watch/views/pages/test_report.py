"""The report: the page of a run as one file, whatever its names say, and never a reason for a run to fail."""

import base64
import json
from contextlib import closing
from pathlib import Path
from shutil import rmtree
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import pytest
from pydantic import BaseModel

from panolog.orchestrator.cli.session import session  # cli_results has commands to register
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.runs.records import Noticed, Stored, TaskFailed
from panolog.orchestrator.watch.dashboard.messages import (
    EventList,
    HeldOutViews,
    PreviewList,
    RunPage,
    Series,
)
from panolog.orchestrator.watch.views.pages.report import write_report
from panolog.orchestrator.watch.views.plan_page import BlockCameras, CameraView
from panolog.scene.errors import InputError, RunError
from panolog.workers.seams.schema import SeamsFile
from panolog.workers.tasks import COARSE
from tests.orchestrator.cli.program import call
from tests.orchestrator.fakes import Harness, fails
from tests.orchestrator.history import BEGAN, append, begun
from tests.orchestrator.watch.views.pages.snapshots import self_contained, snapshot_of
from tests.visual.compare import expand
from tests.workers.seams.test_schema import seam

SCRIPT = "</script><script>alert(1)</script>"


def begin(folder: RunFolder, scene: str = "/scenes/street") -> None:
    begun(folder.root, scene=scene, seed=7)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run that has ended well."""
    harness = Harness(tmp_path_factory.mktemp("report"), eval={"seams": 0})
    begin(harness.folder)
    harness.drive()
    return harness.folder


class Report:
    """What a report holds, by the paths below /api of its run."""

    def __init__(self, page: Path) -> None:
        self.text = page.read_text()
        held = snapshot_of(self.text)
        self.answers: dict[str, Any] = held["answers"]
        self.run = RunPage.model_validate(held["stream"]["run"])

    def __getitem__(self, path: str) -> Any:
        return self.answers[f"runs/report/{path}"]


def test_a_finished_run_is_one_self_contained_page(done: RunFolder) -> None:
    report = Report(write_report(done))
    assert self_contained(report.text)
    assert report.run.summary.status == "done"
    assert {setting.key: setting.value for setting in report.run.config}["width"] == 64
    assert report.run.info["versions"]["torch"].startswith("2") and report.run.info["seed"] == 7
    assert set(report[f"series?task={COARSE}"]) == {"loss", "rate"}
    assert report["map"]["blocks"]["colors"][0] and report["findings"]["metrics"]["mean"]["psnr"] == 24
    assert report["views/0"].startswith("data:image/jpeg;base64,")


def test_a_reader_elsewhere_sees_no_path_and_what_is_next_to_the_report(
    done: RunFolder, tmp_path: Path
) -> None:
    scene = read_info(done).scene.path
    done.page.write_text("a page")
    within = Report(write_report(done))
    elsewhere = Report(write_report(done, tmp_path / "page.html"))
    done.page.unlink()
    for report in (within, elsewhere):
        assert str(done.root) not in report.text and scene not in report.text
        assert report.run.info["scene"]["path"] == Path(scene).name
    assert (within.run.result.view, within.run.result.model) == (True, True)
    assert (elsewhere.run.result.view, elsewhere.run.result.model) == (False, False)


def test_its_answers_are_those_of_the_dashboard(done: RunFolder) -> None:
    """Each is one of a model of the dashboard's messages, for all cameras, blocks and tasks of the run."""
    report = Report(write_report(done))
    tasks = [task.name for task in report.run.summary.tasks if task.iteration is not None]
    kinds: dict[str, type[BaseModel]] = {"views": HeldOutViews, "previews": PreviewList, "events": EventList}
    rows = {row for block in report.run.summary.blocks for row in _rows(report, block.block)}
    kinds |= {f"block/{block.block}": BlockCameras for block in report.run.summary.blocks}
    kinds |= {f"camera/{row}": CameraView for row in rows}
    for path, kind in kinds.items():
        kind.model_validate(report[path])
    for task in tasks:
        for curve in report[f"series?task={quote(task, safe='')}"].values():
            Series.model_validate(curve)
    assert len(tasks) > 2 and rows and not report["events"]["more"]
    assert "Progressed" not in {event["type"] for event in report["events"]["events"]}


def _rows(report: Report, block: int) -> list[int]:
    return [camera["row"] for camera in report[f"block/{block}"]["cameras"]]


def test_a_failed_run_has_a_report_with_its_reason(tmp_path: Path) -> None:
    harness, crash = Harness(tmp_path), Failed("CUDA error: <misaligned>")
    begin(harness.folder)
    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        with pytest.raises(RunError):
            harness.drive(fails(COARSE, crash, 9))
        session._report(harness.folder, Journal(database))
    report = Report(harness.folder.report)
    assert (report.run.summary.status, report.run.summary.label) == ("failed", "failed")
    assert "CUDA error: <misaligned>" in str(report.run.summary.reason)


def test_other_peoples_words_stay_words(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "<img src=x onerror=alert(1)>")
    folder.root.mkdir()
    begin(folder, SCRIPT)
    failed = TaskFailed(COARSE, 1, SCRIPT, final=True)
    append(folder, BEGAN, Noticed(COARSE, SCRIPT), failed)
    folder.make(folder.metrics.parent)
    write_json(folder.metrics, {"views": {SCRIPT: {"psnr": 1.0}}, "lpips_reason": SCRIPT})
    report = Report(write_report(folder))
    assert "alert(1)</script>" not in report.text
    assert "<img src=x" not in report.text
    assert report.run.summary.notices[0].message == SCRIPT
    assert report["findings"]["metrics"]["lpips_reason"] == SCRIPT


def test_a_run_that_has_hardly_begun_has_a_report_too(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    begin(folder)
    assert "runs/report/events" not in Report(write_report(folder)).answers
    append(folder, BEGAN)
    report = Report(write_report(folder))
    assert report.run.summary.label == "driver lost"
    assert [event["type"] for event in report["events"]["events"]] == ["RunBegan"]


def test_pictures_are_few_and_small_and_only_the_runs_own(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.images.mkdir(parents=True)
    begin(folder)
    picture = bytes(cv2.imencode(".jpg", np.zeros((1028, 2048, 3), np.uint8))[1])
    views = {f"{i:02d}.png": {"psnr": float(i)} for i in range(40)}
    for name in views:
        (folder.images / name).with_suffix(".jpg").write_bytes(picture)
    (folder.images / "20.jpg").write_bytes(b"no picture")
    (tmp_path / "secret.jpg").write_bytes(picture)
    write_json(folder.metrics, {"views": views | {"../../../secret.png": {"psnr": 99.0}, "gone.png": {}}})
    report = Report(write_report(folder))
    shown = [view["name"] for view in report["views"]["views"]]
    assert len(shown) in (11, 12)
    assert (shown[0], shown[-1]) == ("00.png", "39.png")
    assert not {"../../../secret.png", "gone.png", "20.png"} & set(shown)
    for number in range(len(shown)):
        raw = base64.b64decode(report[f"views/{number}"].partition(",")[2])
        assert expand(raw).shape[1] <= 2048
    assert len(report.text) < 8_000_000


def test_the_driver_writes_the_report_and_one_that_cannot_be_written_is_a_notice(tmp_path: Path) -> None:
    harness = Harness(tmp_path)
    begin(harness.folder)
    shown: list[Stored] = []
    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        harness.drive()
        session._report(harness.folder, Journal(database, lambda state, news: shown.extend(news)))
        assert not shown
        assert Report(harness.folder.report).run.summary.status == "done"
        harness.folder.report.unlink()
        harness.folder.report.mkdir()
        session._report(harness.folder, Journal(database, lambda state, news: shown.extend(news)))
    (notice,) = [stored.record for stored in shown]
    assert isinstance(notice, Noticed) and "`panolog report" in notice.message
    assert (harness.state.outcome, list(harness.state.notices)[-1].task) == ("done", "report")


def test_the_command_says_where_the_report_is(done: RunFolder, tmp_path: Path) -> None:
    for options, path in (([], done.report), (["-o", tmp_path / "r.html"], tmp_path / "r.html")):
        result = call("report", done.root, *options)
        assert (result.exit_code, result.stdout) == (0, f"{path}\n")
        assert path.is_file()
    assert call("report", tmp_path).exit_code == 2


def test_the_report_has_the_seams_and_pictures_of_the_worst(done: RunFolder) -> None:
    assert Report(write_report(done))["findings"]["seams"] == []
    write_json(done.seams, SeamsFile.of((seam(1, 1.75), seam(2, None))).model_dump(mode="json"))
    place = done.seam(0, 1)  # the first has pictures
    place.mkdir(parents=True)
    for name in ("truth.jpg", "merged.jpg", "below.jpg", "above.jpg", "face.png"):
        cv2.imwrite(str(place / name), np.zeros((3, 4, 3), np.uint8))
    try:
        report = Report(write_report(done))
        found = report["findings"]
        assert [(face["blocks"], face["seam"]) for face in found["seams"]] == [([0, 1], 1.75), ([0, 2], None)]
        assert report["map"]["blocks"]["grades"] == [["seam 1.5 to 3", found["colors"][0]]]
        assert found["colors"][1] is None
        assert {name.split("-")[-1] for name in found["pictures"]} == {path.name for path in place.iterdir()}
        kinds = {name[-3:]: report[f"findings/{name}"].partition(";")[0] for name in found["pictures"]}
        assert kinds == {"jpg": "data:image/jpeg", "png": "data:image/png"}
    finally:
        done.seams.unlink()
        rmtree(place)


def test_the_report_has_movers_and_only_the_runs_own_pictures(done: RunFolder, tmp_path: Path) -> None:
    names = {"walk/a.jpg": 0.03, "b.jpg": 0.0, "c.jpg": 0.01, "../../secret.jpg": 0.5}
    panoramas = [{"name": name, "share": share} for name, share in names.items()]
    write_json(done.mover_shares, {"panoramas": panoramas, "pictures": []})
    secret = done.mover_picture("../../secret.jpg").resolve()
    for path in (done.mover_picture("walk/a.jpg"), secret):
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((32, 64, 3), np.uint8))
    report = Report(write_report(done, tmp_path / "page.html"))
    found = report["findings"]
    order = ["../../secret.jpg", "walk/a.jpg", "c.jpg", "b.jpg"]
    assert [mover["name"] for mover in found["movers"]] == order
    assert found["pictures"] == ["mover-1.jpg"]
    assert report["findings/mover-1.jpg"].startswith("data:image/jpeg")
    done.mover_shares.write_bytes(b'{"panoramas": [1]}')
    with pytest.raises(InputError, match=r"movers\.json: is damaged"):
        write_report(done, tmp_path / "page.html")
    done.mover_shares.unlink()
    rmtree(done.movers)
    secret.unlink()
    assert Report(write_report(done, tmp_path / "page.html"))["findings"]["movers"] == []


def test_refined_poses_are_there_the_farthest_first(done: RunFolder, tmp_path: Path) -> None:
    one = {"name": "a.jpg", "moved": 0.01, "turned": 0.1, "pixels": 1.5, "at_bound": False}
    moves = [one, one | {"name": "b.jpg", "pixels": 2.5}]
    write_json(done.poses, {"panoramas": moves})
    metrics = json.loads(done.metrics.read_bytes())
    there = {"psnr": 27.25, "ws_psnr": 26.5, "lpips": None, "cc_psnr": 28.0, "pixels": 0.75}
    write_json(done.metrics, metrics | {"pose_fit": {"mean": there, "views": {}}})
    try:
        found = Report(write_report(done, tmp_path / "page.html"))["findings"]
        assert found["moves"] == moves[::-1]
        assert found["metrics"]["pose_fit"]["mean"] == there
    finally:
        done.poses.unlink()
        write_json(done.metrics, metrics)
