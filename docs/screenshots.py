"""Makes the pictures of docs/dashboard.md: `PYTHONPATH=. python docs/screenshots.py FOLDER [RUN]`.

`python docs/screenshots.py --model RUN CAMERA` makes that of the README instead: the 3D page of a run, which
begins at the panorama CAMERA (of the demo: street_004.png). `python docs/screenshots.py --viewers RUN` makes
that of docs/export.md: the model of a run in three viewers, two of which npm installs.

Needs the development dependencies and Chromium. FOLDER is one that `panolog dashboard` would serve; RUN is
the name of a run in it, by default the latest.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, Literal

import cv2
import httpx
import numpy as np
from playwright.sync_api import Browser, Page, expect

from panolog.export.site.write import write_site
from panolog.orchestrator.cli.commands.export import ExportSpec, export_model
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.dashboard import guard, server
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_file
from panolog.scene.write import no_progress
from tests.export.browser import SOFTWARE, serving
from tests.export.site import test_viewers as viewers
from tests.orchestrator.watch.dashboard.browser import DESK, PHONE, chromium

HERE = Path(__file__).parent
_PATIENCE = 600_000  # milliseconds: without a GPU each frame takes seconds


def take_pictures(url: str, name: str | None) -> None:
    """Takes all three pictures."""
    runs = httpx.get(f"{url}/api/runs").json()["runs"]
    run = next(run for run in runs if name in (None, run["name"]))
    with chromium() as browser:
        page = open_page(browser, url, DESK, 560, "light")
        expect(page.locator("#runs tbody tr")).to_have_count(len(runs))
        for cover in page.locator("#runs .cover:visible").all():
            expect(cover).not_to_have_js_property("naturalWidth", 0)
        page.screenshot(path=HERE / "dashboard-runs.png")
        page = open_page(browser, f"{url}/runs/{run['id']}", DESK, 1640, "light")
        show_everything(page)
        page.screenshot(path=HERE / "dashboard-run.png")
        page = open_page(browser, f"{url}/runs/{run['id']}", PHONE, 1240, "dark")
        show_everything(page)
        page.screenshot(path=HERE / "dashboard-phone.png")


def take_model_picture(folder: Path, camera: str) -> None:
    """Takes the picture of the 3D page of a run."""
    with TemporaryDirectory() as temporary, chromium() as browser:
        html = Path(temporary) / "page.html"
        write_file(site_of_run(RunFolder(folder), Wanted(camera=camera)), html)
        page = browser.new_page(viewport={"width": 1600, "height": 900})
        page.set_default_timeout(_PATIENCE)
        page.goto(html.as_uri())
        expect(page.locator("#home")).to_be_enabled(timeout=_PATIENCE)
        page.locator("#more").click()
        page.wait_for_timeout(5_000)  # drawn in full resolution
        page.screenshot(path=HERE / "view-3d.jpg", type="jpeg", quality=82)


def take_viewers_picture(folder: Path) -> None:
    """Takes the picture of a model in PlayCanvas's engine, in SuperSplat's viewer, and in Spark."""
    run = RunFolder(folder)
    shown = site_of_run(run, Wanted())
    assert shown.page.start is not None
    pictures = []
    with TemporaryDirectory() as temporary, chromium(SOFTWARE) as browser:
        site = Path(temporary) / "site"
        write_site(site, shown.write_model, shown.page)
        export_model(folder, site, ExportSpec(("ply", "spz")), no_progress, print)
        viewers.lay_out(Path(temporary))
        x, y, z = shown.page.start.position
        stand = f"camera.position.set({x}, {y}, {z}); camera.rotation.y = {np.radians(shown.page.start.yaw)}"
        with serving(Path(temporary)) as url:
            for address, ready, then in (
                ("site/index.html", "#home:enabled", ""),
                (viewers.supersplat_address(f"{folder.name}.ply"), "canvas", ""),
                (f"spark.html?site/{folder.name}.spz", "canvas", stand),
            ):
                page = browser.new_page(viewport={"width": 640, "height": 400})
                page.set_default_timeout(_PATIENCE)
                page.goto(url + address)
                page.locator(ready).wait_for(timeout=_PATIENCE)
                page.evaluate(then)
                page.wait_for_timeout(20_000)  # drawn in full resolution
                data = np.frombuffer(page.screenshot(), np.uint8)
                pictures.append(cv2.imdecode(data, cv2.IMREAD_COLOR))
                page.close()
    cv2.imwrite(str(HERE / "viewers.jpg"), np.concatenate(pictures, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 82])


def open_page(browser: Browser, url: str, width: int, height: int, theme: Literal["light", "dark"]) -> Page:
    """A page in a viewport of that size; on a phone with two device pixels per pixel."""
    size: Any = {"width": width, "height": height}
    scale = 2 if width == PHONE else 1
    context = browser.new_context(viewport=size, color_scheme=theme, device_scale_factor=scale)
    page = context.new_page()
    page.goto(url)
    return page


def show_everything(page: Page) -> None:
    """Chooses a block and waits until map, charts and pictures are drawn."""
    expect(page.locator("#map-plot .points")).to_be_attached(timeout=60_000)
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached(timeout=60_000)
    page.locator("#block-table tr[data-block='0'] button").click()
    page.mouse.move(0, 0)
    page.evaluate("scrollTo(0, 0)")
    page.wait_for_timeout(2_000)  # charts and pictures are drawn


def main() -> None:
    """The program."""
    if sys.argv[1:2] == ["--model"]:
        take_model_picture(Path(sys.argv[2]), sys.argv[3])
        return
    if sys.argv[1:2] == ["--viewers"]:
        take_viewers_picture(Path(sys.argv[2]))
        return
    listener = guard.listen("127.0.0.1", 0)
    running = server.make_server(Path(sys.argv[1]), listener, None)
    thread = Thread(target=running.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        take_pictures(
            f"http://127.0.0.1:{listener.getsockname()[1]}", sys.argv[2] if len(sys.argv) > 2 else None
        )
    finally:
        running.should_exit = True
        thread.join()


if __name__ == "__main__":
    main()
