"""What the page of a run says of its machines, those in use, in quarantine and leaving, and of its store."""

import socket
import time
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.records import (
    Leaving,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeReleased,
    RunBegan,
)
from panolog.orchestrator.runs.storage.state import MirrorState, write_state
from panolog.orchestrator.runs.store import Database
from tests.orchestrator.watch.dashboard.browser import PHONE, opened
from tests.orchestrator.watch.dashboard.served import append, serving, write_whole_run
from tests.orchestrator.watch.dashboard.test_browser import settled
from tests.visual import legible

pytestmark = pytest.mark.system

GIB = 2**30
REASON = "3 tasks have failed there in a row, the last one, block/001: CUDA error"
QUARANTINED = NodeQuarantined("3f2a81c4d5e6", "gpu-07", REASON, 2e9)
LEAVES = NodeLeaving("7f2a81c4d5e6", "gpu-08", Leaving.PREEMPTION, 120.0)
METERS = ["CPU63%", "Memory5 GiB of 8 GiB", "GPU 083%", "GPU 0 memory22 GiB of 24 GiB"]
METERS += ["GPU 1 memory22 GiB of 24 GiB", "Disk1 GiB of 9 GiB"]


def test_machines_and_the_store_are_shown_and_a_machine_is_released(browser: Browser, tmp_path: Path) -> None:
    folder = write_whole_run(tmp_path / "run")
    append(folder, RunBegan(socket.gethostname(), 1, resumed=True), LEAVES, QUARANTINED)
    used = {"cpu": 0.63, "memory_used": 5 * GIB, "memory_total": 8 * GIB}
    disk = {"disk_used": GIB, "disk_total": 9 * GIB}
    gpu = {"name": "A", "utilization": 0.83, "memory_used": 22 * GIB, "memory_total": 24 * GIB}
    with closing(Database(folder.database)) as database:
        database.put_usage(socket.gethostname(), used | disk | {"gpus": [gpu, gpu | {"utilization": None}]})
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
        expect(page.locator(".meters li")).to_have_text(METERS)
        expect(page.locator(".meters [data-full='true']")).to_have_count(2)
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
