"""The 3D page in a real browser, from the disk: what it draws, and the panel over it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page, expect

from panolog.orchestrator.views.model_page import write_page
from panolog.orchestrator.views.viewpoints import Viewpoint, Viewpoints
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply
from tests.orchestrator.dashboard.browser import DESK, KEYBOARD, PHONE, chromium, opened
from tests.orchestrator.views.pictures import layers, observe_sorting, psnr, rendered, shown
from tests.orchestrator.views.test_model_page import some
from tests.visual import legible

SIZE = (480, 320)
AT = {f"street/{i:03d}.jpg": Viewpoint(np.array([0.0, 0, i]), np.array([0, 0, 1.0])) for i in range(250)}
VIEWS = Viewpoints(np.array([0, -1.0, 0]), AT["street/000.jpg"], AT)

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


def cloud() -> Gaussians:
    """Gaussians of all shapes and opacities around a point ahead, and a sky of dots."""
    model = some(3000, sky=1000, seed=3)
    far = (torch.arange(3000) >= 2000)[:, None]
    return replace(
        model,
        means=model.means - torch.tensor([10.0, 20, 30]) + torch.where(far, 0, torch.tensor([0, 0, 6.0])),
        scales=model.scales + torch.where(far, 1.2, 2.0),
        opacities=model.opacities + 1.5,
    )


@pytest.mark.parametrize("model", [layers(VIEWS), cloud()], ids=["layers", "cloud"])
def test_the_picture_from_the_disk_is_that_of_our_renderer(
    browser: Browser, tmp_path: Path, model: Gaussians
) -> None:
    write_ply(tmp_path / "model.ply", model)
    write_page(tmp_path / "model.ply", tmp_path / "page.html", title="model", viewpoints=VIEWS)
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    observe_sorting(page)
    page.goto((tmp_path / "page.html").as_uri())
    picture = shown(page)
    ours = rendered(model, VIEWS, SIZE, background=picture[0, 0])
    quality = psnr(picture, ours)
    assert sorted(page.evaluate("sorted")) == list(range(len(model)))
    assert quality >= 25, f"{quality:.1f} dB"
    page.close()


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with 250 of 300 Gaussians, sky and many cameras."""
    folder = tmp_path_factory.mktemp("page")
    write_ply(folder / "model.ply", some(300, sky=100))
    write_page(
        folder / "model.ply", folder / "page.html", title="model of <b>run</b>", most=250, viewpoints=VIEWS
    )
    return folder / "page.html"


def note(page: Page, name: str) -> None:
    """Notes where viser's camera is."""
    page.evaluate(f"window.{name} = __viserMutable.camera.position.clone()")


def wait_until(page: Page, relation: str, name: str) -> None:
    """Waits until the camera is where it was noted, or elsewhere."""
    page.wait_for_function(f"__viserMutable.camera.position.distanceTo({name}) {relation} 1e-2")


def three(text: str) -> bool:
    """What three.js reports of viser's client."""
    return "THREE." in text


@pytest.mark.parametrize("width", [PHONE, DESK])
def test_the_panel_says_what_is_shown_and_controls_the_view(browser: Browser, html: Path, width: int) -> None:
    with opened(browser, html.as_uri(), width=width, tolerate=three) as page:
        panel = page.locator("#panolog")
        expect(page.locator("#panolog-home")).to_be_enabled()
        expect(panel.locator("h1")).to_have_text("model of <b>run</b>")
        sky = page.evaluate("JSON.parse(document.getElementById('panolog-page').textContent).sky")
        expect(page.locator("#panolog-count")).to_have_text(f"250 of 300 Gaussians, {sky} of them sky")
        note(page, "begin")

        page.click("#panolog-list")
        expect(page.locator("#panolog-names button")).to_have_count(200)
        expect(page.locator("#panolog-found")).to_have_text("the first 200 of 250")
        page.fill("#panolog-search", "none")
        expect(page.locator("#panolog-found")).to_have_text("no camera has such a name")
        page.fill("#panolog-search", "24")
        expect(page.locator("#panolog-names button")).to_have_count(13)
        page.keyboard.press("ArrowDown")
        page.keyboard.press("ArrowDown")
        assert page.evaluate("document.activeElement.textContent") == "street/124.jpg"
        page.keyboard.press("Enter")
        wait_until(page, ">", "begin")
        expect(page.locator("#panolog-cameras")).to_be_visible(visible=width == DESK)
        page.click("#panolog-home")
        wait_until(page, "<", "begin")

        seen = "__viserSceneTree.getState()['/sky'].effectiveVisibility"
        assert page.evaluate(seen)
        page.click("#panolog-sky")
        page.wait_for_function(f"!{seen}")
        expect(page.locator("#panolog-sky")).to_have_attribute("aria-pressed", "false")
        page.click("#panolog-sky")
        page.wait_for_function(seen)

        page.click("#panolog-how")
        expect(page.locator("#panolog-cameras")).to_be_hidden()
        expect(page.locator("#panolog-help")).to_be_visible()
        page.keyboard.press("Escape")
        expect(page.locator("#panolog-help")).to_be_hidden()
        expect(page.locator("#panolog-how")).to_be_focused()


@pytest.mark.parametrize("width", [PHONE, DESK])
def test_the_panel_is_legible_fits_and_needs_no_mouse(browser: Browser, html: Path, width: int) -> None:
    with opened(browser, html.as_uri(), width=width, tolerate=three) as page:
        expect(page.locator("#panolog-home")).to_be_enabled()
        for opener in ("list", "how"):
            page.locator(f"#panolog-{opener}").focus()
            page.keyboard.press("Enter")
            assert legible.low_contrast(page, whole=False) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            box = page.locator("#panolog").bounding_box()
            assert box is not None
            assert box["x"] + box["width"] <= width
            assert box["y"] + box["height"] <= 900
            page.locator("#panolog-home").focus()
            page.keyboard.press("Tab")
            state = page.evaluate(KEYBOARD)
            assert (state["focused"], state["seen"]) == ("panolog-sky", True)


def test_the_address_names_the_camera_to_begin_at(browser: Browser, html: Path) -> None:
    with opened(browser, f"{html.as_uri()}#camera=street%2F007.jpg", tolerate=three) as page:
        expect(page.locator("#panolog-home")).to_be_enabled()
        note(page, "begin")
        page.click("#panolog-list")
        expect(page.locator("#panolog-names [aria-current]")).to_have_text("street/007.jpg")
        page.click("#panolog-names button >> nth=0")
        wait_until(page, ">", "begin")
        page.click("#panolog-home")
        wait_until(page, "<", "begin")
