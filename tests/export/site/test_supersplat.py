"""SuperSplat's viewer opens a site's model as it lies there: upright, at the site's start."""

import shutil
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page as BrowserPage

from panolog.export.frame import HALF_TURN
from panolog.export.site.page import Page, Pose
from panolog.export.site.write import write_site
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory, Splats
from tests.export.browser import serving, software_page
from tests.export.gaussians import cluster
from tests.export.peers import peer

pytestmark = [pytest.mark.system, pytest.mark.nightly]

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
    shutil.copytree(peer("@playcanvas/supersplat-viewer") / "public", tmp_path / "viewer")
    (tmp_path / "viewer" / "favicon.ico").touch()  # which a browser requests
    site(tmp_path / "viewer" / "site")
    address = "index.html?content=site/model.sog&settings=site/settings.json&noanim&noui"
    shown = "window.firstFrame = () => { window.shown = true; }"
    with serving(tmp_path / "viewer") as url, software_page(url + address, first=shown) as page:
        page.wait_for_function("window.shown", timeout=300_000)
        image = picture(page)
    places = {name: center(image, channel) for name, channel in CHANNELS.items()}
    assert places["left"][0] < 0.4 and places["right"][0] > 0.6
    assert places["above"][1] < 0.35 < places["left"][1]
    assert places["left"][1] == pytest.approx(0.5, abs=0.05) == places["right"][1]
