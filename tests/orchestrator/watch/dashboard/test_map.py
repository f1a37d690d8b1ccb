"""The map in a real browser: its pixels, and how it is moved, zoomed and read."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, expect

from panolog.orchestrator.engine.stages.outline import write_sketch
from tests.orchestrator.watch.dashboard.browser import PLACE, opened
from tests.orchestrator.watch.dashboard.served import serving, write_whole_run

pytestmark = pytest.mark.system


def test_the_map_is_drawn_moved_and_zoomed_without_plotly(browser: Browser, tmp_path: Path) -> None:
    """A run that begins shows its points before anything of a curve is loaded."""
    folder = write_whole_run(tmp_path / "town")
    points = np.random.default_rng(0).normal(size=(300, 3)) * [5, 3, 1]
    write_sketch(folder, ["0.jpg", "1.jpg"], points[:2], points, points[:3])

    def pixels() -> NDArray[np.int16]:
        raw = np.frombuffer(plot.screenshot(animations="disabled"), np.uint8)
        picture = cv2.imdecode(raw, cv2.IMREAD_COLOR)
        assert picture is not None
        return picture.astype(np.int16)

    def moved() -> tuple[float, float]:
        """How far two cameras are from each other, in pixels."""
        (left, top), (right, bottom) = page.evaluate(PLACE, 0), page.evaluate(PLACE, 1)
        return right - left, bottom - top

    missed = re.compile("ERR_FAILED|the charts could not be loaded")
    with (
        serving(tmp_path) as served,
        opened(browser, f"{served.url}/runs/{served.id('town')}", tolerate=missed.search) as page,
    ):
        plot = page.locator("#map-plot")
        page.route("**/vendor/*", lambda route: route.abort())
        page.reload()
        expect(plot.locator(".points")).to_be_attached()
        page.mouse.move(0, 0)
        x, y = page.evaluate(PLACE, 0)
        box = plot.bounding_box()
        assert box is not None
        color = str(plot.locator(".cameras").first.get_attribute("fill"))
        camera = [int(color[i : i + 2], 16) for i in (5, 3, 1)]
        before = pixels()
        assert abs(before[int(y - box["y"]), int(x - box["x"])] - camera).max() < 12
        for part, least in ((".fixes", 30), (".points", 100), (".blocks", 10_000)):
            page.add_style_tag(content=f"#map-plot {part} {{ visibility: hidden }}")
            assert (abs(pixels() - before).max(axis=2) > 12).sum() > least, part
        page.mouse.move(*page.evaluate(PLACE, 0))  # it may have been scrolled
        expect(plot.locator(".tip")).to_contain_text("0.jpg")
        expect(plot.locator(".tip")).to_contain_text("trains block")
        across, down = moved()
        page.get_by_role("button", name="Zoom in").click()
        expect(plot.locator(".tip")).to_be_hidden()
        assert moved() == pytest.approx((1.6 * across, 1.6 * down), abs=0.1)
        x, y = page.evaluate(PLACE, 0)
        page.mouse.move(x + 60, y + 60)
        page.mouse.down()
        page.mouse.move(x + 100, y + 85)
        page.mouse.up()
        assert page.evaluate(PLACE, 0) == pytest.approx([x + 40, y + 25], abs=0.1)
        expect(page.locator("#selected h3")).to_have_count(0)  # the end of a drag is no click
        page.get_by_role("button", name="All").click()
        assert moved() == pytest.approx((across, down), abs=0.1)
