"""Viewers of others show what is exported upright: SuperSplat's, which has PlayCanvas's engine, and Spark."""

import shutil
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Page as BrowserPage

from panolog.export.formats import ChosenModel, write_format
from panolog.export.frame import HALF_TURN, Frame
from panolog.export.georeference import Georeference
from panolog.export.site.page import Page, Pose
from panolog.export.site.write import write_site
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory, Splats
from panolog.scene.ply import write_ply
from tests.export.browser import serving, software_page
from tests.export.gaussians import cluster
from tests.export.peers import peer

pytestmark = [pytest.mark.system, pytest.mark.nightly]

# As it is to be seen from (0, 2, 0) towards -z: red on the left, green on the right, blue above.
COLOURS = {(-4, 2, -10): (1, 0, 0), (4, 2, -10): (0, 1, 0), (0, 5, -10): (0, 0, 1)}
FILES = {"sog": "model.sog", "ply": "model.ply", "compressed-ply": "model.compressed.ply", "spz": "model.spz"}
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


def exported(folder: Path) -> None:
    """The clusters as a model with z up, in the formats that viewers open, and the start of a site."""
    upright = Splats.joined([cluster(place, colour) for place, colour in COLOURS.items()])
    z_up = Frame(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    ply, place = folder / "raw.ply", Georeference(up=(0.0, 0.0, 1.0))
    write_ply(ply, upright.turned(z_up).gaussians())
    for kind, name in FILES.items():
        write_format(kind, ChosenModel(ply, place), folder / name)


def seen_upright(image: NDArray[np.float64]) -> None:
    """Red is on the left, green on the right, both half-way up, and blue above."""
    places = {name: center(image, channel) for name, channel in CHANNELS.items()}
    assert places["left"][0] < 0.4 and places["right"][0] > 0.6
    assert places["above"][1] < 0.35 < places["left"][1]
    assert places["left"][1] == pytest.approx(0.5, abs=0.05) == places["right"][1]


def picture(page: BrowserPage) -> NDArray[np.float64]:
    """(H, W, 3) what the page shows, in [0, 1]."""
    return np.asarray(Image.open(BytesIO(page.screenshot())).convert("RGB"), np.float64) / 255


def center(image: NDArray[np.float64], channel: int) -> tuple[float, float]:
    """(x, y) the mean place, as fractions, of the pixels in which a channel is far above the others."""
    others = np.delete(image, channel, axis=2).max(axis=2)
    rows, columns = np.nonzero(image[:, :, channel] - others > 0.3)
    assert len(rows) > 200, f"nothing of channel {channel}"
    return float(columns.mean() / image.shape[1]), float(rows.mean() / image.shape[0])


def lay_out(folder: Path) -> None:
    """Both viewers in a folder; the models that they show are below `folder`/site."""
    shutil.copytree(peer("@playcanvas/supersplat-viewer") / "public", folder, dirs_exist_ok=True)
    for name, package in (("three", "three"), ("spark", "@sparkjsdev/spark")):
        (folder / name).symlink_to(peer(package))
    shutil.copy(Path(__file__).with_name("spark.html"), folder)
    (folder / "favicon.ico").touch()  # which a browser requests


def supersplat_address(file: str) -> str:
    """Where SuperSplat's viewer shows a file of the site, from the site's start."""
    return f"index.html?content=site/{file}&settings=site/settings.json&noanim&noui"


def supersplat(folder: Path, file: str) -> NDArray[np.float64]:
    """What SuperSplat's viewer shows of a file of the site in a folder."""
    lay_out(folder)
    shown = "window.firstFrame = () => { window.shown = true; }"
    with serving(folder) as url, software_page(url + supersplat_address(file), first=shown) as page:
        page.wait_for_function("window.shown", timeout=300_000)
        return picture(page)


def spark(folder: Path, file: str) -> NDArray[np.float64]:
    """What Spark shows of a file, of those with y down as its own example shows models of 3DGS."""
    lay_out(folder)
    turned = "" if file.endswith(".spz") else "&turned"
    with serving(folder) as url, software_page(f"{url}spark.html?site/{file}{turned}") as page:
        # Spark sorts in a worker, and draws the result in a later frame.
        page.wait_for_function("window.frames_drawn > 20", timeout=300_000)
        return picture(page)


def test_supersplat_shows_a_site_at_its_start(tmp_path: Path) -> None:
    site(tmp_path / "site")
    seen_upright(supersplat(tmp_path, "model.sog"))


@pytest.mark.parametrize(
    ("viewer", "kind"),
    [
        *((supersplat, kind) for kind in ("sog", "ply", "compressed-ply")),
        *((spark, kind) for kind in ("sog", "ply", "spz")),
    ],
)
def test_files_are_shown_upright(
    tmp_path: Path, viewer: Callable[[Path, str], NDArray[np.float64]], kind: str
) -> None:
    site(tmp_path / "site")
    exported(tmp_path / "site")
    seen_upright(viewer(tmp_path, FILES[kind]))
