"""The report in a real browser, opened from disk without a network, wide and narrow, light and dark."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.records import (
    EvaluationSaved,
    Noticed,
    Outcome,
    RunEnded,
    TaskFailed,
    ViewEvaluated,
)
from panolog.orchestrator.watch.views.block_colors import SEAM_GRADES
from panolog.orchestrator.watch.views.pages.report import write_report
from panolog.workers.seams.schema import SeamsFile
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.browser import PHONE, SMALL, opened, unreachable
from tests.orchestrator.watch.dashboard.served import EVIL, progressed, serving, started, write_whole_run
from tests.orchestrator.watch.views.models import save_model
from tests.visual import legible
from tests.visual.compare import expand
from tests.workers.seams.test_schema import seam

pytestmark = pytest.mark.system

NAME = "a_panorama_with_quite_a_long_name_from_a_camera_2026-11-22T02:47:00.png"
GREEN, BLUE, RED = (0, 160, 0), (200, 60, 0), (0, 0, 200)  # BGR


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that a report shows, also a failed block and a long name; the run itself is gone."""
    folder = write_whole_run(tmp_path_factory.mktemp("report") / "run")
    save_model(folder, COARSE)
    append(folder, *(progressed(COARSE, iteration) for iteration in range(51, 100)))
    append(folder, started(TaskId.block(1)), TaskFailed(TaskId.block(1), 1, "out of memory " * 9, final=True))
    append(folder, Noticed(EVAL, "LPIPS needs the package lpips: pip install lpips"))
    append(folder, *(Noticed(COARSE, f"{EVIL} {number}") for number in range(8)))
    _measure(folder)
    path = write_report(folder, folder.root.parent / "page.html", running=False)
    shutil.rmtree(folder.root)
    return path


def _measure(folder: RunFolder) -> None:
    """What the evaluation of a run leaves in its folder; the render is green, its ground truth blue."""
    both = np.vstack([np.full((128, 256, 3), color, np.uint8) for color in (GREEN, BLUE)])
    cv2.imwrite(str((folder.images / NAME).with_suffix(".jpg")), both)
    values = {"psnr": 20.0, "ssim": 0.5, "ws_psnr": 21.5, "lpips": None}
    write_json(
        folder.metrics,
        {
            "mean": values | {"cc_psnr": 22.25},
            "views": {NAME: values, EVIL: values},
            "pose_fit": {"mean": values | {"psnr": 27.25, "pixels": 0.75}},
            "lpips_reason": "LPIPS needs the package lpips",
        },
    )
    write_json(folder.seams, SeamsFile.of((seam(1, 1.75),)).model_dump(mode="json"))
    for name in ("truth.jpg", "merged.jpg", "below.jpg", "above.jpg", "face.png"):
        folder.seam(0, 1).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder.seam(0, 1) / name), np.full((48, 64, 3), GREEN, np.uint8))
    moved = {"name": "0.jpg", "moved": 0.01, "turned": 0.1, "pixels": 1.5, "at_bound": True}
    write_json(folder.poses, {"panoramas": [moved]})
    movers = [{"name": name, "share": share} for name, share in (("0.jpg", 0.03), ("1.jpg", 0.0))]
    write_json(folder.mover_shares, {"panoramas": movers})
    folder.mover_picture("0.jpg").parent.mkdir(parents=True)
    cv2.imwrite(str(folder.mover_picture("0.jpg")), np.full((64, 128, 3), RED, np.uint8))


def _unfold(page: Page) -> None:
    """Shows all cards."""
    for button in page.locator(".fold:visible").all():
        button.click()


def _colors(page: Page, selector: str) -> tuple[int, int, int]:
    """The mean colour that the page shows there, as blue, green and red."""
    picture = expand(page.locator(selector).first.screenshot())
    blue, green, red = picture.reshape(-1, 3).mean(axis=0).round().astype(int).tolist()
    return blue, green, red


def test_all_is_there_without_network(browser: Browser, report: Path) -> None:
    with opened(browser, report.as_uri()) as page:
        page.context.set_offline(True)
        page.reload()
        expect(page.locator("#status")).to_have_text("driver lost")
        expect(page.locator("#block-table")).to_contain_text("out of memory")
        expect(page.locator("#notices > ul li")).to_have_count(6)
        expect(page.locator("#notices > ul li").last).to_contain_text(EVIL)
        expect(page.locator("#quality")).to_contain_text("On average WS-PSNR 21.50 dB, PSNR 20.00 dB")
        expect(page.locator("#quality")).to_contain_text("fit of each render's colours PSNR 22.25 dB")
        expect(page.locator("#quality")).to_contain_text(EVIL)
        expect(page.locator("#seams")).to_contain_text("Blocks 0 and 1: seam 1.75")
        expect(page.locator("#poses")).to_contain_text("moved what they see by 1.50 pixels on average")
        expect(page.locator("#poses")).to_contain_text("0.75 pixels away on average, they have WS-PSNR")
        expect(page.locator("#movers")).to_contain_text("1 of 2 panoramas have some, 1.50 %")
        assert "pip install" not in str(page.locator("body").text_content())
        expect(page.locator("#map-plot")).to_be_hidden()
        expect(page.locator("#quality")).not_to_contain_text("LPIPS needs")  # it is of no use to a reader
        _unfold(page)
        expect(page.locator("#map-plot")).to_be_visible()
        expect(page.locator(".chart").first.locator(".scatterlayer .trace")).to_have_count(2)
        expect(page.locator("#actions button, #selected button, #cost:visible")).to_have_count(0)
        page.wait_for_function("[...document.images].every((image) => image.naturalWidth)")
        page.locator(".face .mark").check()
        expect(page.locator(".strips .line").first).to_be_visible()


def test_the_dashboard_shows_it_in_a_sandbox(browser: Browser, report: Path, tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    shutil.copy(report, folder.report)
    with serving(tmp_path) as served:
        url = f"{served.url}/api/runs/{served.id('run')}/report.html"
        with opened(browser, url) as page:
            expect(page.locator("#quality tbody tr")).to_have_count(2)
            _unfold(page)
            expect(page.locator("#map-plot .blocks")).to_have_count(1)
            assert page.evaluate("self.origin") == "null"


@pytest.fixture(scope="module")
def unfolded(browser: Browser, report: Path) -> Iterator[Page]:
    """The report with all cards shown, for tests that each use a part of their own."""
    with opened(browser, report.as_uri()) as page:
        _unfold(page)
        yield page


def test_the_map_is_that_of_the_dashboard(unfolded: Page) -> None:
    expect(unfolded.locator("#map-plot .blocks")).to_have_count(1)
    expect(unfolded.locator("#map-plot")).to_have_attribute(
        "aria-label", "The partition from above: 2 blocks (1 kept, 1 failed), 50% done"
    )
    face = unfolded.locator("#map-plot .seams")
    red, green, blue = (int(SEAM_GRADES["some"][1][i : i + 2], 16) for i in (1, 3, 5))
    expect(face).to_have_css("stroke", f"rgb({red}, {green}, {blue})")
    expect(unfolded.locator("#legend")).to_contain_text("seam 1.5 to 3")
    unfolded.get_by_label("Camera", exact=True).fill("1.jpg")
    unfolded.get_by_label("Camera", exact=True).press("Enter")
    expect(unfolded.locator("#selected")).to_contain_text("trains it: it is in this block")
    unfolded.locator("#block-table tr[data-block='0'] button").click()
    expect(unfolded.locator("#selected")).to_contain_text("cameras: ")


def test_pictures_are_shown_flat_and_around(unfolded: Page) -> None:
    unfolded.locator("#quality").get_by_role("button", name=NAME).click()
    expect(unfolded.locator("#stage .compare")).to_be_visible()
    unfolded.locator("#stage .split").fill("100")
    _, green, red = _colors(unfolded, "#stage .compare")
    assert green > red + 60
    unfolded.locator("#stage .split").fill("0")
    blue, green, _ = _colors(unfolded, "#stage .compare")
    assert blue > green + 60
    unfolded.get_by_role("button", name="360°").click()
    expect(unfolded.locator("#stage canvas")).to_have_attribute("data-angles", "0.000 0.000 0.800")
    assert _colors(unfolded, "#movers img")[2] > 180


def test_all_can_be_read_and_reached(browser: Browser, report: Path) -> None:
    with opened(browser, report.as_uri(), width=PHONE) as page:
        page.emulate_media(reduced_motion="reduce")  # a smooth scroll would still be on its way
        _unfold(page)
        page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        assert legible.hard_to_read(page, PHONE) == []
        assert page.evaluate(SMALL) == []
        assert unreachable(page) == []


def test_a_report_of_a_live_run_says_so(browser: Browser, tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    save_model(folder, COARSE)
    with lock.hold(folder.lock):
        page_file = write_report(folder)
    with opened(browser, page_file.as_uri()) as page:
        expect(page.locator("#status")).to_have_text("last state: running")
        expect(page.locator("#hint")).to_contain_text("still running when this was written: ")
        expect(page.locator("#hint-command")).to_be_empty()


def test_a_finished_one_begins_with_a_picture_and_is_short(browser: Browser, tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    save_model(folder, COARSE)
    _measure(folder)
    names, values = ("good.jpg", "better.jpg", "bad.jpg"), (21.0, 26.0, 18.0)
    views: dict[str, dict[str, float | None]] = {
        name: {"psnr": psnr, "ssim": 0.9, "ws_psnr": psnr} for name, psnr in zip(names, values, strict=True)
    }
    for name in names:
        shutil.copy((folder.images / NAME).with_suffix(".jpg"), folder.picture(name))
    write_json(folder.metrics, {"mean": {"psnr": 20.0}, "views": views})
    folder.page.write_text("a page")
    folder.web.mkdir()
    folder.sog.write_text("a model")
    folder.point_cloud.write_text("a model")
    append(folder, *(ViewEvaluated(EVAL, name, metrics) for name, metrics in views.items()))
    append(folder, EvaluationSaved("eval/metrics.json", {"psnr": 20.0}), RunEnded(Outcome.DONE))
    with opened(browser, write_report(folder, running=False).as_uri(), width=PHONE) as page:
        expect(page.locator("#lead .frames")).to_contain_text("better.jpg, held out: PSNR 26.00 dB")
        expect(page.locator("#verdict")).to_contain_text("From 3 places")
        expect(page.locator("#verdict")).to_contain_text("by 10.0 % of full brightness")
        links = page.locator("#actions a")
        files = links.evaluate_all("them => them.map(it => it.getAttribute('href'))")
        assert files == ["view.html", "web/model.sog", "point_cloud.ply"]
        assert links.all_inner_texts() == ["Open in 3D", "Save for viewers (SOG)", "Save for training (PLY)"]
        expect(page.locator("#scene")).to_be_hidden()
        assert page.evaluate("document.documentElement.scrollHeight") <= 3000
        page.get_by_role("button", name="Show Curves").click()
        expect(page.locator(".chart").first).to_be_visible()
        page.get_by_role("button", name="Hide Curves").click()
        expect(page.locator(".chart").first).to_be_hidden()
