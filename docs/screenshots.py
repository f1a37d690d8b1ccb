"""Makes the pictures of docs/dashboard.md: `PYTHONPATH=. python docs/screenshots.py FOLDER [RUN]`.

`python docs/screenshots.py --model RUN CAMERA` makes that of the README instead: the 3D page of a run, which
begins at the panorama CAMERA (of the demo: street_004.png).

Needs the development dependencies and Chromium. FOLDER is one that `panolog dashboard` would serve; RUN is
the name of a run in it, by default the latest.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, Literal

import httpx
from playwright.sync_api import Browser, Page, expect

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.dashboard import server
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_file
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
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.set_default_timeout(_PATIENCE)
        page.goto(html.as_uri())
        expect(page.locator("#home")).to_be_enabled(timeout=_PATIENCE)
        page.wait_for_timeout(5_000)  # drawn in full resolution
        page.screenshot(path=HERE / "view-3d.jpg", type="jpeg", quality=82)


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
    expect(page.locator("#map-plot .heatmaplayer image").first).to_be_attached(timeout=60_000)
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
    listener = server.listen("127.0.0.1", 0)
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
