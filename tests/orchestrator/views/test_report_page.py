"""The report in a real browser, opened from disk: what is drawn, on a phone and on a desk, light and dark."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, Locator, expect

from panolog.orchestrator.run.folder import write_json
from panolog.orchestrator.run.records import TaskFailed
from panolog.orchestrator.views.report import write_report
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.dashboard.browser import DESK, PHONE, opened
from tests.orchestrator.dashboard.served import append, progressed, started, write_whole_run
from tests.scene.test_ply import gaussians
from tests.visual import legible
from tests.visual.browser import Theme, wait_until_quiet

pytestmark = pytest.mark.system

# The points in the part of a chart with its lines that something else covers.
COVERED = """(chart) => {
  const {left, top, width, height} = chart.querySelector(".nsewdrag").getBoundingClientRect();
  const shares = [0.1, 0.3, 0.5, 0.7, 0.9];
  const places = shares.flatMap((x) => shares.map((y) => [left + x * width, top + y * height]));
  return places.filter(([x, y]) => !document.elementFromPoint(x, y)?.closest(".nsewdrag"));
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run with all that it shows: also a failed block and a picture with red above blue."""
    folder = write_whole_run(tmp_path_factory.mktemp("report") / "run")
    write_ply(folder.model(COARSE), gaussians(50))
    random = np.random.default_rng(0)
    for iteration in range(1, 100):
        append(folder, progressed(COARSE, iteration, gaussians=int(random.integers(400, 500))))
    append(folder, started(TaskId.block(1)), TaskFailed(TaskId.block(1), 1, "out of memory " * 9, final=True))
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:128, :, 2] = picture[128:, :, 0] = 255
    name = "a_panorama_with_quite_a_long_name_from_a_camera_2026-11-22T02:47:00.png"
    cv2.imwrite(str((folder.images / name).with_suffix(".jpg")), picture)
    write_json(folder.metrics, {"views": {name: {"psnr": 20.0, "ssim": 0.5}}, "metrics": {"psnr": 20.0}})
    return write_report(folder)


def pixels(element: Locator) -> NDArray[np.uint8]:
    """(height, width, 3) an element as it is seen."""
    picture = cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture.astype(np.uint8)


def test_nothing_covers_a_curve(browser: Browser, report: Path) -> None:
    inks: dict[Theme, tuple[int, int, int]] = {"light": (35, 28, 23), "dark": (241, 235, 231)}
    with opened(browser, report.as_uri()) as page:
        expect(page.locator(".scatterlayer .trace").first).to_be_attached()
        charts = page.locator(".js-plotly-plot").filter(has_text="iteration")
        assert charts.count() >= 4
        for theme, ink in inks.items():
            page.emulate_media(color_scheme=theme)
            wait_until_quiet(page)
            for chart in charts.all():
                chart.scroll_into_view_if_needed()
                assert chart.evaluate(COVERED) == []
                seen = pixels(chart.locator(".nsewdrag")).reshape(-1, 3)  # where the lines are
                counts = np.unique(seen, axis=0, return_counts=True)[1]
                assert counts.max() / len(seen) > 0.8  # all but lines is one background
                assert (np.abs(seen.astype(int) - ink).max(axis=1) < 90).sum() > 100  # Stage I


def test_all_can_be_read(browser: Browser, report: Path) -> None:
    with opened(browser, report.as_uri(), width=PHONE) as page:
        expect(page.locator(".scatterlayer .trace").first).to_be_attached()
        page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        for width in (PHONE, DESK):
            page.set_viewport_size({"width": width, "height": 900})
            assert legible.sideways(page) == legible.low_contrast_in_both_themes(page) == []
            for table in page.locator("table").all():
                assert table.evaluate("node => node.scrollWidth <= node.parentElement.clientWidth")


def test_pictures_are_compared_and_looked_around_in_and_curves_hidden(browser: Browser, report: Path) -> None:
    with opened(browser, report.as_uri()) as page:
        lines = page.locator(".chart").first.locator(".scatterlayer .trace")
        expect(lines).to_have_count(2)
        page.get_by_role("button", name="Stage I").click()
        expect(lines).to_have_count(1)
        box, slider = page.locator(".compare"), page.get_by_role("slider")
        slider.fill("75")
        box.scroll_into_view_if_needed()
        seen = pixels(box)
        row = seen[len(seen) * 3 // 4]  # below the knob and the names
        width = len(row)
        assert (row[: int(0.73 * width), 2] > 200).mean() > 0.97  # the render: red
        assert (row[int(0.77 * width) :, 0] > 200).mean() > 0.97  # the ground truth: blue
        page.get_by_role("button", name="360°").click()
        canvas = box.locator("canvas")
        expect(canvas).to_have_attribute("data-angles", "0.000 0.000 0.800")
        around = pixels(box)[len(seen) // 2]
        assert around[width // 4, 2] > 200
        assert around[-width // 8, 0] > 200
