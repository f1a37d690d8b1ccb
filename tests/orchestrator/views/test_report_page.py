"""The report in a real browser, opened from disk on a phone, light and dark."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.run.folder import write_json
from panolog.orchestrator.run.records import TaskFailed
from panolog.orchestrator.views.report import write_report
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.dashboard.browser import PHONE, opened
from tests.orchestrator.dashboard.served import append, progressed, started, write_whole_run
from tests.orchestrator.views.models import save_model
from tests.visual import legible

pytestmark = pytest.mark.system


def test_curves_are_hidden_and_all_can_be_read(browser: Browser, tmp_path: Path) -> None:
    """All that a report shows, also a failed block and a long name."""
    folder = write_whole_run(tmp_path / "run")
    save_model(folder, COARSE)
    append(folder, *(progressed(COARSE, iteration) for iteration in range(51, 100)))
    append(folder, started(TaskId.block(1)), TaskFailed(TaskId.block(1), 1, "out of memory " * 9, final=True))
    name = "a_panorama_with_quite_a_long_name_from_a_camera_2026-11-22T02:47:00.png"
    cv2.imwrite(str((folder.images / name).with_suffix(".jpg")), np.zeros((256, 256, 3), np.uint8))
    write_json(folder.metrics, {"views": {name: {"psnr": 20.0, "ssim": 0.5}}, "metrics": {"psnr": 20.0}})
    with opened(browser, write_report(folder).as_uri(), width=PHONE) as page:
        lines = page.locator(".chart").first.locator(".scatterlayer .trace")
        expect(lines).to_have_count(2)
        page.get_by_role("button", name="Stage I").click()
        expect(lines).to_have_count(1)
        page.get_by_role("button", name="360°").click()
        expect(page.locator(".compare canvas")).to_have_attribute("data-angles", "0.000 0.000 0.800")
        page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        assert legible.hard_to_read(page, PHONE) == []
        for table in page.locator("table").all():
            assert table.evaluate("node => node.scrollWidth <= node.parentElement.clientWidth")
