"""The 3D page in a real browser: what it draws, and each way to move in it."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page, expect

from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_folder
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.watch.dashboard.browser import DESK, KEYBOARD, PHONE, SMALL, opened
from tests.orchestrator.watch.views.sites import (
    COUNT,
    SIZE,
    cloud,
    page_of_layers,
    psnr,
    ready,
    rendered,
    run_with,
    serving,
    shown,
    until,
    viewpoints_of,
)
from tests.visual import legible
from tests.visual.browser import wait_until_quiet

pytestmark = pytest.mark.system


def colour(page: Page) -> list[int]:
    """BGR in the middle of the picture."""
    picture = shown(page)
    return [int(value) for value in picture[picture.shape[0] // 2, picture.shape[1] // 2]]


def place(page: Page) -> list[float]:
    """Where the view is."""
    found: list[float] = page.evaluate("[...panolog.flight.position]")
    return found


def rests(page: Page) -> None:
    until(page, "!panolog.flight.travels")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of the page of a run with photographs.

    Its Gaussians are small: what the tests wait for is a GPU in software, which spends its time on pixels.
    """
    root = tmp_path_factory.mktemp("site")
    folder = run_with(root)
    write_ply(folder.model(COARSE), cloud(viewpoints_of(folder), larger=(1.0, 0.0)))
    write_folder(site_of_run(folder, Wanted()), root / "web")
    with serving(root / "web") as url:
        yield url


@pytest.fixture(scope="module")
def page(browser: Browser, site: str) -> Iterator[Page]:
    """The page in a small window, for tests that each begin somewhere of their own."""
    with opened(browser, site, width=800, height=500) as page:
        ready(page)
        yield page


def pass_by(page: Page, seconds: float) -> None:
    """Lets time pass for what moves, however long that takes here."""
    tick = "panolog.walk.update(0.05); panolog.flight.update(0.05)"
    page.evaluate(f"() => {{ for (let t = 0; t < {seconds}; t += 0.05) {{ {tick} }} }}")


def test_the_picture_of_one_file_is_that_of_our_renderer(browser: Browser, tmp_path: Path) -> None:
    file, model, viewpoints = page_of_layers(tmp_path)
    with opened(browser, file.as_uri(), width=SIZE[0], height=SIZE[1]) as page:
        picture = shown(page)
    quality = psnr(picture, rendered(model, viewpoints, SIZE, background=picture[0, 0]))
    assert quality >= 25, f"{quality:.1f} dB"


def test_the_sky_is_behind_the_model_and_can_be_switched_off(browser: Browser, tmp_path: Path) -> None:
    folder = run_with(tmp_path)
    viewpoints = viewpoints_of(folder)
    model = cloud(viewpoints)
    write_folder(site_of_run(folder, Wanted()), tmp_path / "web")
    with serving(tmp_path / "web") as url, opened(browser, url, width=SIZE[0], height=SIZE[1]) as page:
        expect(page.locator("#sky")).to_be_enabled()
        with_sky = shown(page)
        page.locator("#sky").evaluate("button => button.click()")
        without = shown(page)
    scene = model.select(torch.arange(3000) < 2000)
    quality = psnr(with_sky, rendered(model, viewpoints, SIZE, background=np.zeros(3, np.uint8)))
    # The picture of the sky continues what is between its dots.
    assert quality >= 22, f"{quality:.1f} dB with sky"
    quality = psnr(without, rendered(scene, viewpoints, SIZE, background=without[0, 0]))
    assert quality >= 25, f"{quality:.1f} dB without"


def test_the_panel_finds_cameras_and_shows_their_photographs(browser: Browser, site: str) -> None:
    with opened(browser, site, width=PHONE) as page:
        ready(page)
        expect(page.locator("h1")).to_have_text("model of a <run>")
        expect(page).to_have_title("model of a <run>")
        expect(page.locator("#count")).to_have_text("3,000 Gaussians")
        begin = place(page)
        page.click("#list")
        expect(page.locator("#names button")).to_have_count(COUNT)
        page.fill("#search", "none")
        expect(page.locator("#found")).to_have_text("no camera has such a name")
        page.fill("#search", "EVIL")
        page.keyboard.press("ArrowDown")
        assert page.evaluate("document.activeElement.textContent") == "<b>&evil.png"
        page.keyboard.press("Enter")
        expect(page.locator("#cameras")).to_be_hidden()  # at a desk it stays
        rests(page)
        assert page.evaluate("panolog.walk._picture.opacity") == 0
        expect(page.locator("#tag")).to_be_hidden()
        page.evaluate("document.getElementById('photograph').click()")
        until(page, "panolog.walk._picture.opacity === 1")
        expect(page.locator("#tag")).to_have_text("photograph")
        assert np.allclose(place(page), [5, 0, -0.3 - 0.15 + 0.15], atol=0.5)
        assert page.evaluate("decodeURIComponent(location.hash)") == "#camera=<b>&evil.png"
        assert np.allclose(colour(page), [220, 35, 128], atol=6)
        page.locator("#strength").evaluate("s => { s.value = 50; s.dispatchEvent(new Event('input')); }")
        until(page, "panolog.walk._picture.opacity === 0.5")
        page.evaluate("document.getElementById('photograph').click()")
        until(page, "panolog.walk._picture.opacity === 0")
        assert not np.allclose(colour(page), [220, 35, 128], atol=6)
        page.evaluate("document.getElementById('photograph').click()")
        until(page, "panolog.walk._picture.opacity === 0.5")
        page.evaluate("document.getElementById('home').click()")
        until(page, "panolog.walk._picture.opacity === 0")
        rests(page)
        assert np.allclose(place(page), begin)
        expect(page.locator("#photograph")).to_have_attribute("aria-pressed", "false")
        page.evaluate("document.getElementById('photograph').click()")  # it goes to the nearest camera
        until(page, "panolog.walk._picture.opacity === 0.5")


def test_keys_move_turn_and_close(page: Page) -> None:
    page.evaluate("panolog.walk.go(panolog.walk.cameras[5], true)")
    page.focus("#view")
    for key, direction in (("w", [0, 0, 1]), ("s", [0, 0, -1]), ("d", [1, 0, 0]), ("q", [0, -1, 0])):
        before = np.array(place(page))
        axes = page.evaluate(
            "(([x, y, z]) => [[-z, 0, x], [0, 1, 0], [x, y, z]])(panolog.ahead(panolog.flight.yaw, 0))"
        )
        page.keyboard.down(key)
        pass_by(page, 0.4)
        page.keyboard.up(key)
        pass_by(page, 0.9)
        moved = np.array(axes) @ (np.array(place(page)) - before)
        assert np.linalg.norm(moved) > 0.1, key
        assert moved @ direction > 0.95 * np.linalg.norm(moved), key
    yaw = page.evaluate("panolog.flight.yaw")
    page.keyboard.down("ArrowLeft")
    pass_by(page, 0.4)
    page.keyboard.up("ArrowLeft")
    assert 0 < (page.evaluate("panolog.flight.yaw") - yaw + 360) % 360 < 180  # to the left
    page.keyboard.press("h")
    expect(page.locator("#help")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#help")).to_be_hidden()
    expect(page.locator("#how")).to_be_focused()
    page.keyboard.press(".")
    expect(page.locator("#where")).to_have_text("7 / 12 · street/006.png")
    page.keyboard.press(",")
    expect(page.locator("#where")).to_have_text("6 / 12 · street/005.png")
    page.keyboard.press("m")
    expect(page.locator("#measure")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Escape")
    expect(page.locator("#measure")).to_have_attribute("aria-pressed", "false")
    page.click("#more")
    at = place(page)
    page.fill("#seconds", "")
    page.locator("#seconds").press_sequentially("20")  # the 0 is no key of the view
    assert not page.evaluate("panolog.flight.travels") and place(page) == at
    page.keyboard.press("Escape")
    page.focus("#along")
    page.keyboard.press(".")
    expect(page.locator("#where")).to_have_text("7 / 12 · street/006.png")


def test_the_walk_plays_pauses_and_follows_its_slider(page: Page) -> None:
    page.evaluate("panolog.walk.go(panolog.walk.cameras[2], true)")
    page.click("#play")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause the walk")
    while page.evaluate("panolog.walk.place") <= 3.2:
        pass_by(page, 0.1)
    at = page.evaluate("[panolog.walk.place, panolog.flight.position[0]]")
    assert at[1] == pytest.approx(at[0] - 6, abs=0.3)  # along x, from the middle of the cameras
    page.keyboard.down("w")  # the user takes over
    pass_by(page, 0.2)
    page.keyboard.up("w")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play the walk")
    page.locator("#along").fill("9.5")
    assert page.evaluate("panolog.walk.place") == 9.5
    assert page.evaluate("panolog.flight.position[0]") == pytest.approx(3.5, abs=0.2)
    page.evaluate("panolog.walk.toggle()")
    pass_by(page, 30)
    assert page.evaluate("[panolog.walk.place, panolog.walk.plays]") == [11, False]  # at the last camera


def test_a_walk_of_one_camera_cannot_be_played(browser: Browser, tmp_path: Path) -> None:
    """Play did nothing."""
    write_folder(site_of_run(run_with(tmp_path), Wanted()), tmp_path / "web")
    description = tmp_path / "web" / "scene.json"
    content = json.loads(description.read_text())
    description.write_text(json.dumps(content | {"cameras": content["cameras"][:1]}))
    with serving(tmp_path / "web") as url, opened(browser, url, width=800, height=500) as page:
        expect(page.locator("#play")).to_be_disabled()
        expect(page.locator("#play")).to_have_attribute("title", re.compile("two cameras"))


def test_who_wants_no_movement_gets_none(page: Page) -> None:
    page.emulate_media(reduced_motion="reduce")
    page.evaluate("panolog.walk.go(panolog.walk.cameras[5], true)")
    page.focus("#view")
    page.keyboard.press(".")
    assert page.evaluate("panolog.flight.travels") is False
    assert page.evaluate("panolog.flight.position[0]") == 0
    wait = "while (panolog.walk.place === 6) panolog.walk.update(0.05)"
    place = page.evaluate(f"() => {{ panolog.walk.toggle(); {wait}; return panolog.walk.place; }}")
    assert place == 7  # one camera at a time
    page.evaluate("panolog.walk.toggle()")
    page.emulate_media(reduced_motion="no-preference")


def test_fingers_look_around_move_and_go_there(browser: Browser, site: str) -> None:
    with opened(browser, site, width=PHONE) as page:
        ready(page)
        session = page.context.new_cdp_session(page)

        def touch(kind: str, *points: tuple[float, float], at: float | None = None) -> None:
            places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
            moment = {} if at is None else {"timestamp": at}
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places, **moment})

        before, yaw = place(page), page.evaluate("panolog.flight.yaw")
        touch("touchStart", (200, 500))
        for x in range(210, 310, 10):
            touch("touchMove", (x, 500))
        touch("touchEnd")
        turned = (page.evaluate("panolog.flight.yaw") - yaw + 540) % 360 - 180
        assert 5 < turned < 30  # the place under the finger stays there
        assert place(page) == before
        touch("touchStart", (150, 500), (250, 500))
        for by in range(5, 60, 5):
            touch("touchMove", (150 - by, 500), (250 + by, 500))
        touch("touchEnd")
        moved = np.array(place(page)) - before
        ahead = np.array(page.evaluate("panolog.ahead(panolog.flight.yaw, panolog.flight.pitch)"))
        assert moved @ ahead > 0.3
        page.evaluate("panolog.walk.go(panolog.walk.cameras[2], true)")
        touch("touchStart", (300, 500))
        for x in range(290, 190, -10):  # back towards the model
            touch("touchMove", (x, 500))
        touch("touchEnd")
        before = place(page)
        first = time.time()
        for at in (first, first + 0.1):  # calls are farther apart on a loaded machine
            touch("touchStart", (195, 430), at=at)
            touch("touchEnd", at=at + 0.02)
        until(page, f"Math.hypot(...panolog.flight.position.map((x, i) => x - {before}[i])) > 1")


def test_orbit_keeps_the_distance_to_a_point(page: Page) -> None:
    page.evaluate("panolog.walk.go(panolog.walk.cameras[5], true)")
    page.click("#orbit")
    expect(page.locator("#orbit")).to_have_attribute("aria-pressed", "true")
    pivot = (
        "(({position, yaw, pitch, pivot}) => panolog.shifted(position, panolog.ahead(yaw, pitch), pivot))"
        "(panolog.flight)"
    )
    before, centre = place(page), page.evaluate(pivot)
    page.mouse.move(420, 250)
    page.mouse.down()
    page.mouse.move(570, 270, steps=5)
    page.mouse.up()
    assert np.linalg.norm(np.array(place(page)) - before) > 0.3
    assert np.allclose(page.evaluate(pivot), centre, atol=1e-6)
    nearer = page.evaluate("panolog.flight.pivot")
    page.mouse.wheel(0, -300)
    until(page, f"panolog.flight.pivot !== {nearer}")
    assert np.allclose(page.evaluate(pivot), centre, atol=1e-6)
    page.click("#orbit")


def test_the_page_is_legible_fits_and_needs_no_mouse(browser: Browser, site: str) -> None:
    with opened(browser, site, width=PHONE) as page:
        ready(page)
        assert page.evaluate(SMALL) == []
        for opener, width in (("list", DESK), ("list", PHONE), ("more", PHONE), ("how", PHONE)):
            page.set_viewport_size({"width": width, "height": 850})
            if page.locator(f"#{opener}").get_attribute("aria-expanded") != "true":
                page.locator(f"#{opener}").focus()
                page.keyboard.press("Enter")
            wait_until_quiet(page)
            assert legible.low_contrast(page, whole=False) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            for part in ("panel", "walk"):
                box = page.locator(f"#{part}").bounding_box()
                assert box is not None
                assert box["x"] >= 0
                assert box["x"] + box["width"] <= width
                assert box["y"] + box["height"] <= 850
        page.locator("#home").focus()
        page.keyboard.press("Tab")
        state = page.evaluate(KEYBOARD)
        assert (state["focused"], state["seen"]) == ("list", True)
        wanted = {"view", "home", "list", "measure", "orbit", "sky", "more", "how", "play", "along"}
        assert wanted <= set(state["reachable"])


def test_the_address_names_the_camera_to_begin_at(browser: Browser, site: str) -> None:
    with opened(browser, f"{site}#camera=street%2F007.png", width=SIZE[0], height=SIZE[1]) as page:
        ready(page)
        assert page.evaluate("panolog.walk.current.name") == "street/007.png"
        assert page.evaluate("panolog.flight.position[0]") == 1
        page.evaluate("location.hash = '#camera=street%2F001.png'")
        until(page, "panolog.walk.current?.name === 'street/001.png'")
        rests(page)
        page.click("#home")
        rests(page)
        assert page.evaluate("panolog.flight.position[0]") == 1
        page.evaluate("location.hash = '#camera=none'")
        page.reload()
        ready(page)
        expect(page.locator("#where")).to_have_text("there is no camera none")


# Waits until nothing was drawn in 60 frames one after the other, at most for 1,200 frames.
STILL = """async () => {
  let drawn = 0, still = 0;
  panolog.stage.onDrawn.push(() => { drawn += 1; });
  for (let frame = 0; frame < 1200 && still < 60; frame += 1) {
    const before = drawn;
    await new Promise((resolve) => requestAnimationFrame(resolve));
    still = drawn === before ? still + 1 : 0;
  }
  return still;
}"""


def test_a_page_that_rests_draws_nothing(page: Page) -> None:
    page.evaluate("panolog.walk.go(panolog.walk.cameras[5], true)")
    assert page.evaluate(STILL) == 60
