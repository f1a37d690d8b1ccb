"""A live run from start to end with its page open, while server and driver are killed."""

import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from playwright.sync_api import Locator, Page, expect

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan, TaskStarted
from panolog.orchestrator.run.state import replay
from panolog.orchestrator.run.store import read_milestones, read_records
from panolog.synthetic.make import make_town
from tests.orchestrator.dashboard.browser import chromium, opened

pytestmark = pytest.mark.system

SETTINGS: tuple[str, ...] = ("--iterations", "1500", "--device", "cpu", "--blocks", "2x1x1")
SETTINGS += tuple(
    word
    for setting in (
        "sky.count=300",
        "checkpoint.every=30",
        "checkpoint.share=1",
        "preview.every=120",
        "densify.until=300",
    )
    for word in ("--set", setting)
)
LONG = 120_000  # milliseconds that a stage may take on a busy machine
LINES = "() => document.querySelector('#charts .trace path.js-line')?.getAttribute('d')?.length ?? 0"
FILLED = "() => Number(document.getElementById('map-plot').ariaLabel.match(/(\\d+)% done/)[1])"
PROGRAM = "from panolog.orchestrator.cli.app import main; main()"
# A driver whose workers train slowly, so that the page can be looked at meanwhile without much computing:
# they rest after each event, in Stage I until a file is gone.
SLOW = """
import os, sys, time
from dataclasses import dataclass, replace
from panolog.orchestrator.cli import app
from panolog.orchestrator.commands import session
from panolog.orchestrator.driver.driver import Driver
from panolog.workers import stopping
from panolog.workers.training.trainer import TrainSpec

file = sys.argv.pop(1)

@dataclass(frozen=True, eq=False, kw_only=True)
class Slow(TrainSpec):
    file: str

    def run(self):
        for event in super().run():
            yield event
            end = time.monotonic() + 0.6
            while time.monotonic() < end and self.rests() and not stopping.requested():
                time.sleep(0.05)

    def rests(self):
        return self.cell is not None or os.path.exists(self.file)

def slow(spec):
    return Slow(**vars(spec), file=file) if isinstance(spec, TrainSpec) else spec

def driver(job, journal, pool, hooks, stop):
    return Driver(job, journal, pool, replace(hooks, on_start=slow), stop)

session.Driver = driver
app.main()
"""


def panolog(*arguments: object, program: str = PROGRAM) -> subprocess.Popen[bytes]:
    """The program. It says little enough for its pipe."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait(30)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def nothing_left(root: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Ends what is listed, and every driver and worker that the run has recorded."""
    processes: list[subprocess.Popen[bytes]] = []
    try:
        yield processes
    finally:
        for process in processes:
            kill(process)
        if RunFolder(root).database.exists():
            records = [stored.record for stored in read_records(RunFolder(root).database, limit=100_000)]
            for pid in {r.pid for r in records if isinstance(r, RunBegan | TaskStarted)}:
                with suppress(psutil.NoSuchProcess):
                    if "panolog" in " ".join(psutil.Process(pid).cmdline()):
                        psutil.Process(pid).kill()


def grows(page: Page, script: str) -> Callable[[], None]:
    """Call it later: by then, or soon after, a number of the page must have become larger."""
    before, last = page.evaluate(script), time.monotonic() + LONG / 1000

    def wait() -> None:
        while page.evaluate(script) <= before:  # the page's policy does not let the browser wait for a script
            assert time.monotonic() < last, f"{before} does not grow"
            page.wait_for_timeout(100)

    return wait


def iteration(row: Locator) -> int:
    found = re.match(r"[\d,]+", str(row.locator("[data-column='iteration']").text_content()))
    return int(found[0].replace(",", "")) if found else 0


def act(page: Page, name: str, title: str, yes: str | None = None) -> None:
    """Presses a button of an action and confirms it."""
    page.get_by_role("button", name=name, exact=True).first.click()
    expect(page.locator("#confirm-title")).to_have_text(title)
    page.locator("#confirm").get_by_role("button", name=yes or name, exact=True).click()
    expect(page.locator("#confirm")).to_be_hidden()


@pytest.mark.timeout(600)
def test_a_run_is_followed_and_steered_from_start_to_end(tmp_path: Path) -> None:
    scene = make_town(tmp_path / "town", panoramas=9, width=96, points=400)
    folder, port = tmp_path / "runs", free_port()
    root = folder / "live"
    folder.mkdir()
    url = f"http://127.0.0.1:{port}"
    away = re.compile("ERR_(CONNECTION_REFUSED|CONNECTION_RESET|INCOMPLETE_CHUNKED|EMPTY_RESPONSE)")

    def serve() -> subprocess.Popen[bytes]:
        server = panolog("dashboard", folder, "--port", port)
        processes.append(server)
        assert server.stderr is not None
        assert server.stderr.readline().decode().strip().rstrip("/") == url  # it listens
        return server

    with chromium() as browser, nothing_left(root) as processes:
        server = serve()
        with opened(browser, url, tolerate=lambda text: bool(away.search(text))) as page:
            expect(page.locator("#empty")).to_contain_text("No run here yet", timeout=LONG)
            (slow := tmp_path / "slow").touch()
            driver = panolog(slow, "run", scene, "-o", root, *SETTINGS, program=SLOW)
            processes.append(driver)
            page.get_by_role("link", name="live").click(timeout=LONG)
            stage_one_moves(page)
            slow.unlink()
            blocks_fill(page)
            pause_and_go_on(page)
            server = restart(page, server, serve)
            kill(driver)
            expect(page.locator("#status")).to_have_text("driver lost", timeout=LONG)
            expect(page.locator("#block-table .pill[data-status='running']")).to_have_count(0)
            act(page, "Resume", "Resume the run?")
            expect(page.locator("#status")).to_have_text("running", timeout=LONG)
            all_is_done(page)
            page.get_by_role("link", name="All runs").click()
            expect(page.locator("#runs tbody .pill")).to_have_text("done")
        state = replay(read_milestones(RunFolder(root).database))
        assert state.outcome == "done"
        assert server.poll() is None


def stage_one_moves(page: Page) -> None:
    row = page.locator("#block-table tr[data-block='-1']")
    expect(row.locator(".pill")).to_have_text("running", timeout=LONG)
    expect(page.locator("#nodes li").first).to_contain_text("Stage I")
    expect(page.locator("#map-empty")).to_be_visible()
    expect(page.locator("#status")).to_have_text("running")
    expect(page.locator("#stages li[data-key='coarse']")).to_have_attribute("data-status", "running")
    before = iteration(row)
    expect(page.locator("#charts .scatterlayer .trace").first).to_be_attached(timeout=LONG)
    lines = grows(page, LINES)
    expect(page.locator(".compare")).to_be_visible(timeout=LONG)
    lines()
    assert iteration(row) > before


def blocks_fill(page: Page) -> None:
    expect(page.locator("#map-plot .heatmaplayer image").first).to_be_attached(timeout=2 * LONG)
    expect(page.locator("#block-table tr[data-block='0'] .pill")).to_have_text("running", timeout=LONG)
    grows(page, FILLED)()
    expect(page.locator("#events")).to_contain_text("2 blocks")


def pause_and_go_on(page: Page) -> None:
    row = page.locator("#block-table tr[data-block='0']")
    row.get_by_role("button").click()
    act(page, "Pause", "Pause block 0?")
    expect(row.locator(".pill")).to_have_text("paused", timeout=LONG)
    expect(page.locator("#selected .pill")).to_have_text("paused")
    expect(page.locator("#events")).to_contain_text("Pause requested")
    act(page, "Resume", "Resume block 0?")
    expect(row.locator(".pill")).not_to_have_text("paused", timeout=LONG)


def restart(page: Page, server: subprocess.Popen[bytes], serve: Callable[[], Any]) -> Any:
    kill(server)
    expect(page.locator("#connection")).to_be_visible(timeout=LONG)
    expect(page.locator("#connection")).to_contain_text("Connection lost")
    again = serve()
    expect(page.locator("#connection")).to_be_hidden(timeout=LONG)
    row = page.locator("#block-table tr[data-status], #block-table tr").filter(has_text="running").first
    expect(row).to_be_visible(timeout=LONG)
    before = iteration(row)
    expect(row.locator("[data-column='iteration'] span")).not_to_have_text(
        re.compile(f"^{before:,} /"), timeout=LONG
    )
    return again


def all_is_done(page: Page) -> None:
    expect(page.locator("#status")).to_have_text("done", timeout=2 * LONG)
    expect(page.locator("#block-table .pill[data-status='done']")).to_have_count(4)  # and the repair
    expect(page.locator("#facts")).to_contain_text(re.compile(r"\d\d\.\d\d dB"))
    assert page.evaluate("document.querySelectorAll('#stages [data-status=done]').length") == 9
    expect(page.locator("#events")).to_contain_text("resumed the run")
    expect(page.locator("#view-source optgroup[label='Held-out views'] option")).to_have_count(2)
    page.locator("#view-source").select_option(label="street_000.png")
    expect(page.locator(".frames")).to_contain_text("held out: PSNR")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download PLY").click()
    with Path(download.value.path()).open("rb") as file:
        assert file.read(4) == b"ply\n"
    expect(page.get_by_role("link", name="Report")).to_be_visible()
    with page.expect_popup() as view:
        page.locator("#actions").get_by_role("button", name="3D view").click()
    view.value.wait_for_url(re.compile("/models/"), timeout=LONG)
    view.value.close()
