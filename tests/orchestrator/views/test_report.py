"""The report: one page with all of a run, whatever its names say, and never a reason for a run to fail."""

import json
import re
from contextlib import closing
from html import unescape
from pathlib import Path
from shutil import rmtree
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.commands import session  # cli_results has commands to register
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.resources.pool import Failed
from panolog.orchestrator.run import lock
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder, write_json
from panolog.orchestrator.run.info import SceneRef, make_info, write_info
from panolog.orchestrator.run.records import Noticed, RunBegan, Stored, TaskFailed
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.views.report import report_or_notice, write_report
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import write_ply
from panolog.workers.seams.schema import SeamsFile
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.served import write_whole_run
from tests.orchestrator.fakes import Harness, fails
from tests.scene.test_ply import gaussians
from tests.workers.seams.test_schema import seam

SCRIPT = "</script><script>alert(1)</script>"


def begin(folder: RunFolder, scene: str = "/scenes/street") -> None:
    write_info(folder, make_info(SceneRef(path=scene, fingerprint="f"), RunConfig(width=64, seed=7)))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run that has ended well."""
    harness = Harness(tmp_path_factory.mktemp("report"), eval={"seams": 0})
    begin(harness.folder)
    harness.drive()
    return harness.folder


def data(page: str) -> dict[str, Any]:
    """What the page's scripts draw."""
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert match is not None
    found: dict[str, Any] = json.loads(match[1])
    return found


def self_contained(page: str) -> bool:
    """Whether a page requests nothing, but for what Plotly's code says."""
    beyond_plotly = page.replace(page[page.index("<script>/**") : page.index("</head>")], "")
    outside = r"""(src|href)\s*=\s*["']?(https?:|//|\.)|^(import|export) """
    return not re.search(outside, beyond_plotly, re.MULTILINE)


def text_of(page: str) -> str:
    """What a reader of the page reads."""
    body = re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]*>", " ", body)))


def test_a_finished_run_is_one_self_contained_page(done: RunFolder) -> None:
    page = write_report(done).read_text()
    curves = data(page)["curves"]
    assert [curve["label"] for curve in curves][:2] == ["Stage I", "block 0"]
    assert set(curves[0]["series"]) == {"loss", "rate"}
    assert curves[0]["color"] is None
    assert data(page)["map"]["blocks"]["colors"][0] == curves[1]["color"]
    for text in ("Stage II", "pano_4.png", "24.00 dB", "202", "/scenes/street", "width", "torch 2", "seed 7"):
        assert text in text_of(page), text
    assert 'src="data:image/jpeg;base64,' in page
    assert self_contained(page)


def test_a_failed_run_has_a_report_with_its_reason(tmp_path: Path) -> None:
    harness, crash = Harness(tmp_path), Failed("CUDA error: <misaligned>")
    begin(harness.folder)
    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        with pytest.raises(RunError):
            harness.drive(fails(COARSE, crash, 9))
        session._report(harness.folder, Journal(database))
    page = text_of(harness.folder.report.read_text())
    assert "run failed" in page
    assert "CUDA error: <misaligned>" in page
    assert not re.search(r"\brunning\b", page)


def test_a_report_of_a_live_run_says_so_and_when(tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    write_ply(folder.model(COARSE), gaussians(50))
    with lock.hold(folder.lock):
        live = text_of(write_report(folder).read_text())
    assert re.search(r"run running .* this page: \d{4}-\d\d-\d\d \d\d:\d\d UTC", live)
    assert re.search(r"still running when this page was written: \d+ % done, about 0:40 left", live)
    assert "Gaussians in training 500" in live
    killed = text_of(write_report(folder).read_text())
    assert "run driver lost" in killed
    assert "still running" not in killed


def test_other_peoples_words_stay_words(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "<img src=x onerror=alert(1)>")
    folder.root.mkdir()
    begin(folder, SCRIPT)
    database = Database(folder.database)
    database.append([RunBegan("host", 1, resumed=False), Noticed(COARSE, SCRIPT)])
    database.append([TaskFailed(COARSE, 1, SCRIPT, final=True)])
    database.close()
    write_json(folder.metrics, {"views": {SCRIPT: {"psnr": 1.0}}, "lpips_reason": SCRIPT})
    page = write_report(folder).read_text()
    assert "alert(1)</script>" not in page
    assert "<img src=x" not in page
    assert page.count("&lt;/script&gt;&lt;script&gt;alert(1)") >= 4


def test_a_run_that_has_hardly_begun_has_a_report_too(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    begin(folder)
    assert "Timeline" in write_report(folder).read_text()
    with closing(Database(folder.database)) as database:
        database.append([RunBegan("host", 1, resumed=False)])
    assert "driver lost" in text_of(write_report(folder).read_text())


def test_pictures_are_few_and_small_and_only_the_runs_own(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.images.mkdir(parents=True)
    begin(folder)
    picture = bytes(cv2.imencode(".jpg", np.zeros((1028, 2048, 3), np.uint8))[1])
    views = {f"{i:02d}.png": {"psnr": float(i)} for i in range(40)}
    for name in views:
        (folder.images / name).with_suffix(".jpg").write_bytes(picture)
    (tmp_path / "secret.jpg").write_bytes(picture)
    write_json(folder.metrics, {"views": views | {"../../../secret.png": {"psnr": 99.0}, "gone.png": {}}})
    page = write_report(folder).read_text()
    shown = re.findall(r'alt="([^"]*?):', page)
    assert len(shown) == 12
    assert (shown[0], shown[-1]) == ("00.png", "39.png")
    assert not any("secret" in name or "gone" in name for name in shown)
    assert len(page) < 8_000_000


def test_what_cannot_be_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a run folder"):
        write_report(RunFolder(tmp_path))
    folder = RunFolder(tmp_path)
    begin(folder)
    folder.metrics.parent.mkdir()
    folder.metrics.write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        write_report(folder)
    (notice,) = report_or_notice(folder)
    assert isinstance(notice, Noticed)
    assert "`panolog report" in notice.message
    assert not folder.report.exists()


def test_the_driver_writes_the_report_and_one_that_cannot_be_written_is_a_notice(tmp_path: Path) -> None:
    harness = Harness(tmp_path)
    begin(harness.folder)
    shown: list[Stored] = []
    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        harness.drive()
        session._report(harness.folder, Journal(database, lambda state, news: shown.extend(news)))
        assert not shown
        assert not re.search(r"\brunning\b", text_of(harness.folder.report.read_text()))
        harness.folder.report.unlink()
        harness.folder.report.mkdir()
        session._report(harness.folder, Journal(database, lambda state, news: shown.extend(news)))
    assert [stored.record.task for stored in shown] == ["report"]
    assert (harness.state.outcome, list(harness.state.notices)[-1].task) == ("done", "report")


def test_the_command_says_where_the_report_is(done: RunFolder, tmp_path: Path) -> None:
    for options, path in (([], done.report), (["-o", str(tmp_path / "r.html")], tmp_path / "r.html")):
        result = CliRunner().invoke(app.app, ["report", str(done.root), *options])
        assert (result.exit_code, result.stdout) == (0, f"{path}\n")
        assert path.is_file()
    assert CliRunner().invoke(app.app, ["report", str(tmp_path)]).exit_code == 2


def test_the_report_shows_the_seams_and_the_worst_in_pictures(done: RunFolder) -> None:
    assert "Seams between blocks" not in text_of(write_report(done).read_text())
    write_json(done.seams, SeamsFile.of((seam(1, 1.75), seam(2, None))).model_dump(mode="json"))
    place = done.seam(0, 1)  # the first has pictures
    place.mkdir(parents=True)
    for name in ("truth.jpg", "merged.jpg", "below.jpg", "above.jpg", "face.png"):
        cv2.imwrite(str(place / name), np.zeros((3, 4, 3), np.uint8))
    try:
        page = write_report(done).read_text()
        text = text_of(page)
        for words in ("Seams between blocks", "Blocks 0 and 1: seam 1.75", "2 faces", "0 | 2", "1.5 to 3"):
            assert words in text, words
        assert "Blocks 0 and 2" not in text
        assert page.count('<img class="line"') == 4
        done.seams.write_bytes(b"{}")
        with pytest.raises(InputError, match=r"seams\.json"):
            write_report(done)
    finally:
        done.seams.unlink()
        rmtree(place)


def test_the_report_shows_movers_and_only_the_runs_own_pictures(done: RunFolder, tmp_path: Path) -> None:
    names = {"walk/a.jpg": 0.03, "b.jpg": 0.0, "c.jpg": 0.01, "../../secret.jpg": 0.5}
    panoramas = [{"name": name, "share": share} for name, share in names.items()]
    write_json(done.mover_shares, {"panoramas": panoramas, "pictures": []})
    secret = done.mover_picture("../../secret.jpg").resolve()
    for path in (done.mover_picture("walk/a.jpg"), secret):
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((32, 64, 3), np.uint8))
    page = write_report(done, tmp_path / "page.html").read_text()
    text = text_of(page)
    assert "3 of 4 panoramas have some, 13.50 % of all that they show." in " ".join(text.split())
    assert page.count("its movers tinted") == 1 and "walk/a.jpg · 3.0 %" in text
    done.mover_shares.write_bytes(b'{"panoramas": [1]}')
    with pytest.raises(InputError, match=r"movers\.json: is damaged"):
        write_report(done, tmp_path / "page.html")
    done.mover_shares.unlink()
    rmtree(done.movers)
    secret.unlink()
    assert "Movers" not in text_of(write_report(done, tmp_path / "page.html").read_text())


def test_the_report_says_what_held_out_panoramas_have_at_fitted_poses(
    done: RunFolder, tmp_path: Path
) -> None:
    moves = {"name": "a.jpg", "moved": 0.01, "turned": 0.1, "pixels": 1.5, "at_bound": False}
    write_json(done.poses, {"panoramas": [moves]})
    metrics = json.loads(done.metrics.read_bytes())
    try:
        page = text_of(write_report(done, tmp_path / "page.html").read_text())
        assert "moved what they see by 1.50 pixels on average." in page and "finished model" not in page
        there = {"psnr": 27.25, "ws_psnr": 26.5, "lpips": None, "cc_psnr": 28.0, "pixels": 0.75}
        write_json(done.metrics, metrics | {"pose_fit": {"mean": there, "views": {}}})
        page = text_of(write_report(done, tmp_path / "page.html").read_text())
        assert "0.75 pixels away on average, they have PSNR 27.25 dB, WS-PSNR 26.50 dB;" in page
        assert "as they are PSNR 24.00 dB." in page
    finally:
        done.poses.unlink()
        write_json(done.metrics, metrics)
