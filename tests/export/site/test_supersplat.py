"""SuperSplat's viewer opens a site's model as it lies there: upright, at the site's start."""

import shutil
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page as BrowserPage
from playwright.sync_api import sync_playwright

from panolog.export.frame import HALF_TURN
from panolog.export.site.page import Page, Pose
from panolog.export.site.write import write_site
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory, Splats
from tests.export.browser import SOFTWARE, chromium, serving
from tests.export.gaussians import cluster
from tests.export.peers import peer

pytestmark = pytest.mark.system

# As it is to be seen from (0, 2, 0) towards -z: red on the left, green on the right, blue above.
COLOURS = {(-4, 2, -10): (1, 0, 0), (4, 2, -10): (0, 1, 0), (0, 5, -10): (0, 0, 1)}
CHANNELS = {"left": 0, "right": 1, "above": 2}


def site(folder: Path) -> None:
    """A page of the clusters whose file has y down, as the writers of SOG get it."""
    upright = Splats.joined([cluster(place, colour) for place, colour in COLOURS.items()])
    means, quats, _ = HALF_TURN.turn(
        upright.means, upright.quats, np.zeros((len(upright), 15, 3), np.float32)
    )
    model = Splats(means, quats, upright.scales, upright.opacities, upright.sh0, upright.shN[:, :0])

    def write(new: Path) -> str:
        write_sog(new / "model.sog", InMemory(model))
        return "model.sog"

    write_site(folder, write, Page("clusters", len(model), start=Pose((0.0, 2.0, 0.0), 0.0)))


def picture(page: BrowserPage) -> NDArray[np.float64]:
    """(H, W, 3) what the page shows, in [0, 1]."""
    return np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB"), np.float64) / 255


def center(image: NDArray[np.float64], channel: int) -> tuple[float, float]:
    """(x, y) the mean place, as fractions, of the pixels in which a channel is far above the others."""
    others = np.delete(image, channel, axis=2).max(axis=2)
    rows, columns = np.nonzero(image[:, :, channel] - others > 0.3)
    assert len(rows) > 200, f"nothing of channel {channel}"
    return float(columns.mean() / image.shape[1]), float(rows.mean() / image.shape[0])


def test_it_shows_a_site_upright_at_its_start(tmp_path: Path) -> None:
    viewer = peer("@playcanvas/supersplat-viewer") / "public"
    shutil.copytree(viewer, tmp_path / "viewer")
    site(tmp_path / "viewer" / "site")
    address = "index.html?content=site/model.sog&settings=site/settings.json&noanim&noui"
    with sync_playwright() as playwright, serving(tmp_path / "viewer") as url:
        browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox", *SOFTWARE])
        page = browser.new_page(viewport={"width": 640, "height": 480})
        thrown: list[str] = []
        page.on("pageerror", lambda error: thrown.append(str(error)))
        page.add_init_script("window.firstFrame = () => { window.shown = true; }")
        page.goto(url + address)
        page.wait_for_function("window.shown", timeout=60_000)
        image = picture(page)
        browser.close()
    assert not thrown
    places = {name: center(image, channel) for name, channel in CHANNELS.items()}
    assert places["left"][0] < 0.4 and places["right"][0] > 0.6
    assert places["above"][1] < 0.35 < places["left"][1]
    assert places["left"][1] == pytest.approx(0.5, abs=0.05) == places["right"][1]
