"""The machines of a run on its page, what is used of them, and those in quarantine; its object store."""

import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.control import Action, ControlRequest
from panolog.orchestrator.run.records import (
    Leaving,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeReleased,
    RunBegan,
)
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.storage.state import MirrorState, write_state
from tests.orchestrator.dashboard.browser import DESK, PHONE, chromium, opened
from tests.orchestrator.dashboard.served import append, serving, write_whole_run
from tests.orchestrator.dashboard.test_browser import settled
from tests.visual import legible

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as running:
        yield running


def test_machines_show_what_is_used(browser: Browser, tmp_path: Path) -> None:
    folder, gib = write_whole_run(tmp_path / "run"), 2**30
    used = {"cpu": 0.63, "memory_used": 5 * gib, "memory_total": 8 * gib}
    disk = {"disk_used": gib, "disk_total": 9 * gib}
    gpu = {"name": "A", "utilization": 0.83, "memory_used": 22 * gib, "memory_total": 24 * gib}
    with closing(Database(folder.database)) as database:
        database.put_usage(socket.gethostname(), used | disk | {"gpus": [gpu, gpu | {"utilization": None}]})
    texts = ["CPU63%", "Memory5 GiB of 8 GiB", "GPU 083%", "GPU 0 memory22 GiB of 24 GiB"]
    texts += ["GPU 1 memory22 GiB of 24 GiB", "Disk1 GiB of 9 GiB"]
    with lock.hold(folder.lock), serving(tmp_path) as server, opened(browser, server.url) as page:
        page.goto(f"{server.url}/runs/{server.id('run')}")
        expect(page.locator(".meters li")).to_have_text(texts)
        expect(page.locator(".meters [data-full='true']")).to_have_count(2)


QUARANTINED = NodeQuarantined(
    "3f2a81c4d5e6", "gpu-07", "3 tasks have failed there in a row, the last one, block/001: CUDA error", 2e9
)


LEAVES = NodeLeaving("3f2a81c4d5e6", "gpu-07", Leaving.PREEMPTION, 120.0)


@pytest.mark.parametrize("width", [DESK, PHONE])
def test_a_machine_that_leaves_is_shown_until_it_has_left(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    folder = write_whole_run(tmp_path / "run")
    append(folder, RunBegan(socket.gethostname(), 1, resumed=True), LEAVES)
    with (
        lock.hold(folder.lock),
        serving(tmp_path) as server,
        opened(browser, server.url, width=width) as page,
    ):
        page.goto(f"{server.url}/runs/{server.id('run')}")
        machine = page.locator("#nodes li", has_text="gpu-07")
        expect(machine).to_contain_text("leaves")
        expect(machine).to_contain_text("left")
        expect(machine).to_contain_text("its provider takes it away; tasks there save a checkpoint and move")
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        append(folder, NodeLeft(LEAVES.node, LEAVES.host))
        expect(machine).to_have_count(0)


@pytest.mark.parametrize("width", [DESK, PHONE])
def test_a_machine_in_quarantine_is_released(browser: Browser, tmp_path: Path, width: int) -> None:
    folder = write_whole_run(tmp_path / "run")
    append(folder, RunBegan(socket.gethostname(), 1, resumed=True), QUARANTINED)
    with (
        lock.hold(folder.lock),
        serving(tmp_path) as server,
        opened(browser, server.url, width=width) as page,
    ):
        control.begin(folder)
        page.goto(f"{server.url}/runs/{server.id('run')}")
        machine = page.locator("#nodes li", has_text="gpu-07")
        expect(machine).to_contain_text("quarantined")
        expect(machine).to_contain_text(QUARANTINED.reason)
        machine.get_by_role("button", name="Release").click()
        expect(page.locator("#confirm")).to_contain_text("Release gpu-07?")
        page.locator("#confirm-yes").click()
        expect(page.locator("#confirm")).to_be_hidden()
        assert control.take(folder) == [ControlRequest(Action.RELEASE, node=QUARANTINED.node)]
        append(folder, NodeReleased(QUARANTINED.node, QUARANTINED.host, "a user has released it"))
        expect(machine).to_have_count(0)
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


@pytest.mark.parametrize("width", [DESK, PHONE])
def test_how_far_an_object_store_is_behind_is_legible(browser: Browser, tmp_path: Path, width: int) -> None:
    place, since = "s3://reconstructions-of-the-city/2026/street/run", time.time() - 1500
    why = f"{place}/.panolog/objects/blocks/000/checkpoint.safetensors/18b2: the store fails (Slow down.)"
    folder = write_whole_run(tmp_path / "run", "/nowhere")
    write_state(
        folder.mirror,
        MirrorState(place, "m", since=since, pending_files=12, pending_bytes=2**33, problem=why),
    )
    with (
        lock.hold(folder.lock),
        serving(tmp_path) as server,
        opened(browser, server.url, width=width) as page,
    ):
        page.goto(f"{server.url}/runs/{server.id('run')}")
        fact = page.locator("#facts div", has_text="Object store")
        expect(fact).to_contain_text("12 files (8.0 GiB) to go")
        expect(fact).to_contain_text("Slow down.")
        settled(page)
        assert legible.low_contrast(page) == legible.sideways(page) == []
