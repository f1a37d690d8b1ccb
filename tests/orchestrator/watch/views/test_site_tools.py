"""The 3D page in a real browser: measuring, streaming, and what goes wrong."""

import json
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, expect

from panolog.orchestrator.watch.views.site.build import Wanted, site_of_file, site_of_run, write_folder
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.views.models import make_run, save_plan, some
from tests.orchestrator.watch.views.sites import (
    SIZE,
    balls,
    cloud,
    psnr,
    ready,
    rendered,
    run_with,
    serving,
    shown,
    until,
    viewpoints_of,
)

pytestmark = pytest.mark.system

WIDTH, HEIGHT = 800, 500  # pixels of a window


def measuring_run(root: Path, metres: float | None) -> Path:
    """The page of two balls, two units apart, five units ahead of the first panorama."""
    folder = make_run(root / "run")
    save_plan(folder)
    viewpoints = viewpoints_of(folder, "0.jpg")
    places = torch.tensor([[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0, 3.0, 30.0]])
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), balls(viewpoints, places, torch.tensor([0.15, 0.15, 0.5])))
    shown = site_of_run(folder, Wanted(camera="0.jpg"))
    write_folder(replace(shown, page=replace(shown.page, metres_per_unit=metres)), root / "web")
    return root / "web"


@pytest.mark.parametrize("metres", [None, 10.0])
def test_a_known_distance_is_measured(browser: Browser, tmp_path: Path, metres: float | None) -> None:
    with (
        serving(measuring_run(tmp_path, metres)) as url,
        opened(browser, url, width=WIDTH, height=HEIGHT) as page,
    ):
        ready(page)
        page.click("#measure")
        focal = WIDTH / 2 / np.tan(np.radians(85 / 2))
        for x in (-1.0, 1.0):
            page.mouse.click(WIDTH / 2 + focal * x / 5, HEIGHT / 2)
            until(page, f"panolog.measure.points.length === {1 if x < 0 else 2}")
        assert page.evaluate("panolog.measure.length") == pytest.approx(2, rel=0.02)
        unit = "units" if metres is None else "m"
        assert unit in page.inner_text("#labels p").split()
        written = float(page.inner_text("#measured strong").split()[0])
        assert written == pytest.approx(2 * (metres or 1), rel=0.02)
        until(page, "document.querySelector('#lines line').getBoundingClientRect().width > 0")  # is drawn
        box = page.locator("#lines line").evaluate("line => line.getBoundingClientRect().toJSON()")
        assert box["width"] == pytest.approx(2 * focal / 5, rel=0.03)
        page.mouse.click(WIDTH / 2, HEIGHT / 2 + 70)  # nothing is there
        expect(page.locator("#measured")).to_contain_text("nothing to measure")
        page.keyboard.press("Escape")
        expect(page.locator("#lines line")).to_have_count(0)


def test_a_damaged_model_or_a_browser_without_webgl_is_one_line(browser: Browser, tmp_path: Path) -> None:
    write_ply(tmp_path / "model.ply", some(30))
    write_folder(site_of_file(tmp_path / "model.ply", Wanted()), tmp_path / "web")
    (tmp_path / "web" / "model.sog").write_bytes(b"no model")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    bare = browser.browser_type.launch(executable_path=path, args=["--no-sandbox", "--disable-3d-apis"])
    lines = {browser: "The model cannot be read", bare: "This browser cannot draw in 3D"}
    with closing(bare), serving(tmp_path / "web") as url:
        for one, line in lines.items():
            with opened(one, url, tolerate=lambda text: "WebGL" in text) as page:
                assert until(page, "document.documentElement.dataset.state") == "failed"
                expect(page.locator("#message")).to_contain_text(line)


def test_a_sog_alone_is_seen_from_outside(browser: Browser, tmp_path: Path) -> None:
    write_ply(tmp_path / "model.ply", replace(some(300), scales=some(300).scales + 2))
    write_folder(site_of_file(tmp_path / "model.ply", Wanted()), tmp_path / "first")
    (tmp_path / "first" / "model.sog").rename(tmp_path / "model.sog")
    write_folder(site_of_file(tmp_path / "model.sog", Wanted()), tmp_path / "web")
    with serving(tmp_path / "web") as url, opened(browser, url, width=WIDTH, height=HEIGHT) as page:
        picture = shown(page)
        assert len(np.unique(picture[150:350, 250:550].reshape(-1, 3), axis=0)) > 1_000
        expect(page.locator("#walk")).to_be_hidden()


def test_a_streamed_model_is_coarse_first_then_fine_and_bounded(browser: Browser, tmp_path: Path) -> None:
    folder = run_with(tmp_path)
    viewpoints = viewpoints_of(folder)
    model = cloud(viewpoints).select(torch.arange(3000) < 2000)
    write_ply(folder.model(COARSE), model)
    write_folder(site_of_run(folder, Wanted(streams=True, levels=2)), tmp_path / "web")
    levels = json.loads((tmp_path / "web" / "model" / "lod-meta.json").read_text())["counts"]
    assert len(levels) > 1
    with serving(tmp_path / "web") as url:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        seen: list[str] = []
        page.on("request", lambda request: seen.append(request.url.removeprefix(url)))
        page.goto(url)
        ready(page)
        first = [name.split("/")[1] for name in seen if name.endswith("/meta.json")]
        assert first
        assert first[0].startswith(f"{len(levels) - 1}_")  # all of the place in its coarsest level
        until(page, "panolog.stage.model.lodRangeMin === 0 && !panolog.stage.loading")
        picture = shown(page)
        drawn = page.evaluate("panolog.stage.app.stats.frame.gsplats")
        page.close()
    assert drawn <= 2000
    quality = psnr(picture, rendered(model, viewpoints, SIZE, background=picture[0, 0]))
    assert quality >= 25, f"{quality:.1f} dB"
