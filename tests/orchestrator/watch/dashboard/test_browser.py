"""The pages in a real browser: what they show, also of machines and the store, on a phone and on a desk."""

import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import APIResponse, Browser, Page, Route, expect
from scipy.sparse import csr_array

from panolog.orchestrator.engine.stages.partitioning import plan_records, write_plan
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.records import (
    Leaving,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeReleased,
    Noticed,
    PreviewSaved,
    RunBegan,
    TaskFailed,
)
from panolog.orchestrator.runs.storage.state import MirrorState, write_state
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.workers.tasks import COARSE, Stage, TaskId
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.browser import (
    DESK,
    PATIENCE_MS,
    PHONE,
    PLACE,
    SMALL,
    opened,
    unreachable,
)
from tests.orchestrator.watch.dashboard.served import (
    EVIL,
    Served,
    progressed,
    serving,
    started,
    write_run,
    write_whole_run,
)
from tests.visual import legible

pytestmark = pytest.mark.system

# Widths of the drawn map, of its card inside, and by how much the page is wider than the window.
WIDTHS = """() => [
  document.querySelector("#map-plot > svg").getBoundingClientRect().width,
  document.getElementById("map").clientWidth,
  document.documentElement.scrollWidth - innerWidth,
]"""


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A run with everything, whose renders differ from the ground truth, and one with hostile names."""
    folder = tmp_path_factory.mktemp("folder")
    whole = write_whole_run(folder / "town")
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[:128, :, 2] = np.linspace(0, 255, 256)  # the render: red, more to the right
    picture[128:, :, 0] = 255  # the ground truth: blue
    for name in ("000050.jpg", "000100.jpg"):
        cv2.imwrite(str(whole.root / "coarse" / "previews" / name), picture)
    append(whole, PreviewSaved(COARSE, 100, "1.jpg", "coarse/previews/000100.jpg"))
    append(whole, TaskFailed(TaskId.block(1), 1, "out of memory", final=False), started(TaskId.block(1)))
    evil = write_run(folder / "<img src=x onerror=alert(1)>", scene=f"/scenes/{EVIL}")
    append(evil, RunBegan(EVIL, 1, resumed=False), Noticed(COARSE, EVIL), started(COARSE))
    append(evil, TaskFailed(COARSE, 1, EVIL, final=True, detail=EVIL))
    with serving(folder) as server:
        yield server


@pytest.fixture(scope="module")
def town(browser: Browser, shown: Served) -> Iterator[Page]:
    """The page of a run, for tests that each use a part of their own and leave the rest as it is."""
    with opened(browser, f"{shown.url}/runs/{shown.id('town')}") as page:
        settled(page)
        yield page


def settled(page: Page) -> None:
    """Waits until the parts that are loaded later are there."""
    expect(page.locator("#map-plot .points")).to_be_attached()
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached()
    expect(page.locator("#events li").first).to_be_visible()


def fills_its_card(page: Page) -> None:
    """Waits until the map is as wide as its card; the page must not scroll sideways meanwhile."""
    expect(page.locator("#map-plot > svg")).to_be_visible()
    last = time.monotonic() + PATIENCE_MS / 1000
    while True:
        map_width, card, more = page.evaluate(WIDTHS)
        assert more <= 0
        if abs(map_width - card) <= 1:
            return
        assert time.monotonic() < last, f"the map has {map_width} pixels of {card}"
        page.wait_for_timeout(100)


def test_the_map_fills_its_card_and_all_is_reached_by_keyboard(browser: Browser, shown: Served) -> None:
    """On a fresh load and after resizing; the focus is seen."""
    with opened(browser, f"{shown.url}/runs/{shown.id('town')}", width=PHONE) as page:
        settled(page)
        fills_its_card(page)
        assert page.evaluate(SMALL) == []
        assert unreachable(page) == []
        for other in (PHONE - 20, 800, DESK):
            page.set_viewport_size({"width": other, "height": 850})
            fills_its_card(page)
        assert unreachable(page) == []


def test_runs_are_found_and_sorted_in_a_theme_that_stays(browser: Browser, shown: Served) -> None:
    background = "getComputedStyle(document.body).backgroundColor"
    with opened(browser, shown.url) as page:
        names = page.locator("#runs .run-name")
        expect(names).to_have_count(2)
        page.locator("#runs").get_by_role("button", name="Run").click()
        first = names.first.text_content()
        page.locator("#runs").get_by_role("button", name="Run").click()
        expect(names.last).to_have_text(str(first))
        page.get_by_label("Search runs").fill("TOWN")
        expect(names).to_have_text(["town"])
        page.get_by_label("Search runs").fill("nothing like it")
        expect(page.locator("#empty")).to_have_text("No run matches the search.")
        light = page.evaluate(background)
        page.get_by_role("button", name="Switch to dark").click()
        dark = page.evaluate(background)
        assert light != dark
        page.reload()
        assert page.evaluate(background) == dark
        page.get_by_role("button", name="Switch to light").click()
        assert page.evaluate(background) == light


def test_runs_have_room_for_their_names_at_any_width(browser: Browser, shown: Served) -> None:
    room = "[...document.querySelectorAll('td .run-name')].map((name) => name.getBoundingClientRect().width)"
    with opened(browser, shown.url) as page:
        expect(page.locator("#runs .run-name")).to_have_count(2)
        for width in (PHONE, 721, 1000, 1001, 1180, 1320, 1321, DESK):
            page.set_viewport_size({"width": width, "height": 900})
            assert min(page.evaluate(room)) >= 100, width
            assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0, width


def test_the_map_says_why_a_camera_trains_its_blocks(town: Page) -> None:
    town.locator("#map-plot .cameras").last.wait_for()
    town.locator("#map-plot").scroll_into_view_if_needed()
    middle = town.evaluate(PLACE, 1)
    town.mouse.move(*middle)
    town.mouse.click(*middle)
    panel = town.locator("#selected")
    expect(panel.locator("h3")).to_have_text("1.jpg")
    expect(panel.locator(".scores li")).to_have_count(2)
    expect(panel.locator(".serves")).to_have_count(2)
    expect(panel).to_contain_text("its gradients here are close to its strongest")
    panel.get_by_role("button", name="block 0").click()
    expect(panel.locator("h3")).to_have_text("block 0")
    expect(town.locator("#block-table tr[aria-current='true']")).to_have_attribute("data-block", "0")
    across, down = town.evaluate(PLACE, 3)
    town.mouse.move(across, down + 60)  # nothing but the cell
    expect(town.locator("#pointed")).to_contain_text("block 1: waiting")
    town.mouse.click(across, down + 60)
    expect(panel.locator("h3")).to_have_text("block 1")
    town.get_by_label("Camera").fill("3.jpg")  # the same without a mouse
    town.get_by_label("Camera").press("Enter")
    expect(panel.locator("h3")).to_have_text("3.jpg")
    town.locator("#block-table tr[data-block='0'] button").click()
    pause = panel.get_by_role("button", name="Pause")
    expect(pause).to_have_attribute("aria-disabled", "true")
    expect(panel).to_contain_text("Not possible now: no driver is at work")
    pause.click(force=True)
    expect(town.locator("#confirm")).to_be_hidden()


def test_blocks_are_filtered_and_sorted(town: Page) -> None:
    rows = town.locator("#block-table tbody tr[data-block]")
    expect(rows).to_have_count(3)
    town.get_by_label("Filter blocks").fill("memory")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("out of memory")
    town.get_by_label("Filter blocks").fill("")
    heads = town.locator("#block-table thead")
    heads.get_by_role("button", name="Block").click()
    expect(rows.first).to_have_attribute("data-block", "1")
    heads.get_by_role("button", name="Retries").click()
    expect(rows.last).to_have_attribute("data-block", "1")


def test_pictures_are_compared_and_looked_around_in(town: Page) -> None:
    town.locator("#view-source").select_option(label="Stage I")
    box = town.locator(".compare")
    expect(box).to_be_visible()
    split = town.locator(".split")
    split.fill("80")
    assert box.evaluate("node => node.style.getPropertyValue('--split')") == "80%"
    expect(town.locator(".frames")).to_contain_text("iteration 100")
    town.get_by_label("Iteration", exact=True).fill("0")
    expect(town.locator(".frames")).to_contain_text("iteration 50")
    town.get_by_role("button", name="360°").click()
    canvas = town.locator(".compare canvas")
    expect(canvas).to_be_focused()
    pixel = """(node, [x, y]) => {
      const gl = node.getContext("webgl"), out = new Uint8Array(4);
      gl.readPixels(x * node.width, y * node.height, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, out);
      return [...out];
    }"""
    expect(canvas).to_have_attribute("data-angles", "0.000 0.000 0.800")
    ahead, truth = canvas.evaluate(pixel, [0.5, 0.5]), canvas.evaluate(pixel, [0.95, 0.5])
    assert 110 < ahead[0] < 145  # the middle of the panorama
    assert truth[2] > 200  # beyond the split
    for _ in range(6):
        town.keyboard.press("ArrowRight")
    expect(canvas).to_have_attribute("data-angles", "0.785 0.000 0.800")
    assert canvas.evaluate(pixel, [0.5, 0.5])[0] > ahead[0] + 20  # an eighth to the right
    town.keyboard.press("+")
    expect(canvas).to_have_attribute("data-angles", "0.785 0.000 0.960")
    place = canvas.bounding_box()
    assert place is not None
    town.mouse.move(place["x"] + 200, place["y"] + 100)
    town.mouse.down()
    town.mouse.move(place["x"] + 100, place["y"] + 160, steps=3)
    town.mouse.up()
    yaw, pitch, _ = map(float, str(canvas.get_attribute("data-angles")).split())
    assert yaw > 0.785
    assert pitch > 0


def test_what_happens_while_the_log_loads_is_in_it(browser: Browser, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False)])
    held: list[tuple[Route, APIResponse]] = []
    with serving(tmp_path) as served, opened(browser, f"{served.url}/runs/{served.id('run')}") as page:
        expect(page.locator("#events li").first).to_be_visible()
        page.route(re.compile(r"/events\?"), lambda route: held.append((route, route.fetch())))
        page.locator("#log-text").fill("late")
        while not held:
            page.wait_for_timeout(20)
        append(folder, Noticed(COARSE, "it is late"))
        expect(page.locator("main")).to_contain_text("it is late")
        for route, answer in held:
            route.fulfill(response=answer)
        expect(page.locator("#log-empty")).to_have_text("")
        expect(page.locator("#events li")).to_have_count(1)


def test_a_repair_has_another_colour_than_stage_one(browser: Browser, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False)])
    for task in (COARSE, TaskId(Stage.REPAIR, 0)):
        append(folder, started(task), progressed(task, 10), progressed(task, 20))
    with serving(tmp_path) as served, opened(browser, f"{served.url}/runs/{served.id('run')}") as page:
        chips = page.locator("#shown .chip")
        expect(chips).to_have_count(2)
        first, second = (chips.nth(number).evaluate("it => it.style.background") for number in (0, 1))
        assert first != second
        marks = page.locator(".chip").evaluate_all("every => every.map(it => it.style.background)")
        assert {first, second} <= set(marks)


def test_the_log_is_filtered(town: Page) -> None:
    events = town.locator("#events li")
    expect(events.first).to_be_visible()
    expect(events.filter(has_text="it/s")).to_have_count(0)
    town.get_by_label("Type").select_option(label="Progress")
    expect(events.filter(has_text="it/s")).to_have_count(41)
    town.get_by_label("Task").select_option(label="Stage I")
    expect(events).to_have_count(1)
    town.get_by_label("Type").select_option(label="all")
    town.get_by_label("Search the log").fill("strange")
    expect(events.filter(has_text="an image is strange")).to_have_count(1)  # not of the list before
    expect(events).to_have_count(1)
    expect(events).to_contain_text("an image is strange")


def test_settings_that_differ_are_marked(town: Page) -> None:
    expect(town.get_by_label("only changed")).to_be_checked()
    expect(town.locator("#setting-table code")).to_have_text(["iterations"])
    expect(town.locator("#setting-table .changed")).to_have_count(1)
    town.get_by_label("Search settings").fill("no such words")
    expect(town.locator("#setting-table tbody")).to_have_text("No setting has these words.")
    town.get_by_label("Search settings").fill("")
    town.get_by_label("only changed").uncheck()
    expect(town.locator("#setting-table code").first).to_have_text("iterations")
    expect(town.locator("#setting-table code").nth(50)).to_be_visible()


def test_what_a_scene_says_stays_text(browser: Browser, shown: Served) -> None:
    def frozen(_: object) -> None:
        raise AssertionError("a script of the scene has run")

    with opened(browser, shown.url) as page:
        page.on("dialog", frozen)
        page.get_by_role("link", name="<img src=x onerror=alert(1)>").click()
        expect(page.locator("h1")).to_have_text("<img src=x onerror=alert(1)>")
        expect(page.locator("#block-table")).to_contain_text(EVIL)
        expect(page.locator("#notices")).to_contain_text(EVIL)
        expect(page.locator("#events")).to_contain_text(EVIL)
        assert page.evaluate("document.querySelectorAll('main script, main img:not([alt])').length") == 0


def test_a_thousand_blocks_cost_no_more_rows_than_are_seen(browser: Browser, tmp_path: Path) -> None:
    random, count = np.random.default_rng(0), 1000
    centers, means = random.normal(size=(400, 3)) * [50, 40, 1], random.normal(size=(5000, 3)) * 50
    scores, names = csr_array(random.random((400, count)) ** 40), [f"{k}.jpg" for k in range(400)]
    grid = Grid((40, 25, 1))
    plan = make_plan(centers, means, scores, grid, PartitionConfig(), rows=range(400), names=names)
    folder = write_run(tmp_path / "city")
    write_plan(folder, plan, scores)
    append(folder, RunBegan(socket.gethostname(), 1, resumed=False), *plan_records(folder, plan, scores))
    with serving(tmp_path) as server, opened(browser, f"{server.url}/runs/{server.id('city')}") as page:
        expect(page.locator("#tally")).to_contain_text("waiting")
        assert page.locator("#block-table tbody tr").count() < 60
        expect(page.locator("#map-plot .points")).to_be_attached()
        page.get_by_label("Filter blocks").fill("block 999")
        expect(page.locator("#block-table tr[data-block]")).to_have_count(1)
        append(folder, started(TaskId.block(999)), progressed(TaskId.block(999), 40))
        expect(page.locator("#block-table tr[data-block]")).to_contain_text("40 / 100")


GIB = 2**30
REASON = "3 tasks have failed there in a row, the last one, block/001: CUDA error"
QUARANTINED = NodeQuarantined("3f2a81c4d5e6", "gpu-07", REASON, 2e9)
LEAVES = NodeLeaving("7f2a81c4d5e6", "gpu-08", Leaving.PREEMPTION, 120.0)


def test_machines_and_the_store_are_shown_and_a_machine_is_released(browser: Browser, tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    append(folder, RunBegan(socket.gethostname(), 1, resumed=True), LEAVES, QUARANTINED)
    gpu = {"name": "A", "utilization": None, "memory_used": 22 * GIB, "memory_total": 24 * GIB}
    used = {"cpu": 0.63, "memory_used": 5 * GIB, "memory_total": 8 * GIB, "disk_used": 0, "disk_total": GIB}
    with closing(Database(folder.database)) as database:
        database.put_usage(socket.gethostname(), used | {"gpus": [gpu, gpu]})
    place, since = "s3://reconstructions-of-the-city/2026/street/run", time.time() - 1500
    why = f"{place}/.panolog/objects/blocks/000/checkpoint.safetensors/18b2: the store fails (Slow down.)"
    behind = MirrorState(place, "m", since=since, pending_files=12, pending_bytes=8 * GIB, problem=why)
    write_state(folder.mirror, behind)
    control.begin(folder)
    with (
        lock.hold(folder.lock),
        serving(tmp_path) as server,
        opened(browser, f"{server.url}/runs/{server.id('run')}") as page,
    ):
        settled(page)
        full = [f"GPU {number} memory22 GiB of 24 GiB" for number in (0, 1)]
        expect(page.locator(".meters [data-full='true']")).to_have_text(full)
        fact = page.locator("#facts div", has_text="Object store")
        expect(fact).to_contain_text("12 files (8.0 GiB) to go")
        expect(fact).to_contain_text("Slow down.")
        leaving, held = (page.locator("#nodes li", has_text=name) for name in ("gpu-08", "gpu-07"))
        expect(leaving).to_contain_text("leaves")
        expect(leaving).to_contain_text("its provider takes it away; tasks there save a checkpoint and move")
        expect(held).to_contain_text("quarantined")
        expect(held).to_contain_text(REASON)
        assert legible.hard_to_read(page, PHONE) == []
        append(folder, NodeLeft(LEAVES.node, LEAVES.host))
        expect(leaving).to_have_count(0)
        held.get_by_role("button", name="Release").click()
        expect(page.locator("#confirm")).to_contain_text("Release gpu-07?")
        page.locator("#confirm-yes").click()
        expect(page.locator("#confirm")).to_be_hidden()
        assert control.take(folder) == [ControlRequest(Action.RELEASE, node=QUARANTINED.node)]
        append(folder, NodeReleased(QUARANTINED.node, QUARANTINED.host, "a user has released it"))
        expect(held).to_have_count(0)
