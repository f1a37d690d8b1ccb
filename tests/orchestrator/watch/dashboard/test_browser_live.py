"""An open page of a run from start to end: what a driver writes appears, and what is clicked is requested."""

import os
import re
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Download, Page, expect

from panolog.export.reading import read_model
from panolog.orchestrator.engine.stages.partitioning import plan_records, write_plan
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    Delivered,
    EvaluationSaved,
    Merged,
    ModelSaved,
    Outcome,
    PauseRequested,
    PlanSaved,
    PreviewSaved,
    RunBegan,
    RunEnded,
    ScoresSaved,
    TaskYielded,
    UnpauseRequested,
    ViewEvaluated,
)
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE, EVAL, TaskId
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.browser import AWAY, opened
from tests.orchestrator.watch.dashboard.served import SCORES, plan, progressed, serving, started, write_run
from tests.orchestrator.watch.dashboard.test_browser import fills_its_card
from tests.orchestrator.watch.views.models import some

pytestmark = pytest.mark.system
FIRST, SECOND, SHARD = TaskId.block(0), TaskId.block(1), TaskId.shard(0)


@pytest.fixture
def driver() -> Iterator[ExitStack]:
    """What the driver of the run holds while it lives."""
    with ExitStack() as held:
        yield held


def began(folder: RunFolder, driver: ExitStack, *, resumed: bool = False) -> None:
    driver.enter_context(lock.hold(folder.lock))
    append(folder, RunBegan(socket.gethostname(), 1, resumed=resumed))
    control.begin(folder)


def picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((16, 16, 3), np.uint8))


def act(page: Page, name: str, title: str) -> None:
    """Presses a button of an action and confirms it."""
    page.get_by_role("button", name=name, exact=True).first.click()
    expect(page.locator("#confirm-title")).to_have_text(title)
    page.locator("#confirm").get_by_role("button", name=name, exact=True).click()
    expect(page.locator("#confirm")).to_be_hidden()


def stage_one_moves(page: Page, folder: RunFolder) -> None:
    row = page.locator("#block-table tr[data-block='-1']")
    expect(row.locator(".pill")).to_have_text("running")
    expect(row).to_contain_text("20 / 100")
    expect(page.locator("#nodes li").first).to_contain_text("Stage I")
    expect(page.locator("#map-empty")).to_be_visible()
    expect(page.locator("#status")).to_have_text("running")
    expect(page.locator("#stages li[data-key='coarse']")).to_have_attribute("data-status", "running")
    line = page.locator("#charts .trace path.js-line").first
    before = str(line.get_attribute("d"))
    expect(page.locator(".compare")).to_be_hidden()
    picture(folder.root / "coarse" / "p.jpg")
    append(folder, *(progressed(COARSE, iteration) for iteration in range(21, 41)))
    append(folder, PreviewSaved(COARSE, 40, "1.jpg", "coarse/p.jpg"))
    expect(page.locator(".compare")).to_be_visible()
    expect(row).to_contain_text("40 / 100")
    expect(line).not_to_have_attribute("d", before)


def blocks_fill(page: Page, folder: RunFolder) -> None:
    append(folder, ModelSaved(COARSE, "coarse/model.ply", 500, 9_000, 100, 12.0))
    append(folder, started(SHARD), ScoresSaved(SHARD, "scores/000.npz", 4))
    write_plan(folder, plan(), SCORES)
    *_, saved = plan_records(folder, plan(), SCORES)
    assert isinstance(saved, PlanSaved)
    blocks = tuple(replace(block, train=True) for block in saved.blocks)
    append(folder, replace(saved, blocks=blocks), started(FIRST), started(SECOND), progressed(FIRST, 30))
    fills_its_card(page)
    expect(page.locator("#block-table tr[data-block='0'] .pill")).to_have_text("running")
    expect(page.locator("#map-plot")).to_have_attribute("aria-label", re.compile("15% done"))
    expect(page.locator("#events")).to_contain_text("2 blocks")


def pause_and_go_on(page: Page, folder: RunFolder) -> None:
    row = page.locator("#block-table tr[data-block='0']")
    row.get_by_role("button").click()
    act(page, "Pause", "Pause block 0?")
    assert control.take(folder) == [ControlRequest(Action.PAUSE, 0)]
    append(folder, PauseRequested(FIRST), TaskYielded(FIRST))
    expect(row.locator(".pill")).to_have_text("paused")
    expect(page.locator("#selected .pill")).to_have_text("paused")
    expect(page.locator("#events")).to_contain_text("Pause requested")
    act(page, "Resume", "Resume block 0?")
    assert control.take(folder) == [ControlRequest(Action.UNPAUSE, 0)]
    append(folder, UnpauseRequested(FIRST), started(FIRST, 30))
    expect(row.locator(".pill")).to_have_text("running")


def the_server_goes(page: Page) -> None:
    """The page says what it knew, and counts no further."""
    page.clock.run_for(60_000)
    line = page.locator("#connection")
    expect(line).to_have_text(re.compile(r"Connection lost at \d\d:\d\d:\d\d — last state: running"))
    expect(page.locator("#status")).to_have_text("last state: running")
    assert page.title() == "live · PanoLOG"
    for id in ("#facts", "#block-table tbody"):
        expect(page.locator(id)).not_to_contain_text(re.compile("ETA|it/s"))
    before = page.locator("#stages").inner_text()
    assert "last state: running" in before
    page.clock.run_for(60_000)
    assert page.locator("#stages").inner_text() == before


def the_driver_goes(page: Page, folder: RunFolder, driver: ExitStack) -> None:
    driver.close()
    expect(page.locator("#status")).to_have_text("driver lost")
    expect(page.locator("#hint")).to_contain_text("The checkpoints are kept. Last update: ")
    expect(page.locator("#hint-command")).to_have_text(f"panolog resume '{folder.root}'")
    expect(page.locator("#block-table .pill[data-status='running']")).to_have_count(0)
    expect(page.locator("#stages")).not_to_contain_text(re.compile(r"^running", re.MULTILINE))


def saved(download: Download, folder: RunFolder, name: str) -> Path:
    """What a browser has saved, in a file next to the run."""
    path = folder.root.parent / name
    download.save_as(path)
    return path


def all_is_done(page: Page, folder: RunFolder, driver: ExitStack) -> None:
    names = ("street/0.png", "street/1.png")
    for name in names:
        picture(folder.picture(name))
    write_ply(folder.point_cloud, some(30))
    folder.report.write_text("<p>1</p>")
    append(folder, *(ModelSaved(task, "model.ply", 500, 9_000, 100, 12.0) for task in (FIRST, SECOND)))
    append(folder, Merged("point_cloud.ply", 500, 10, 4, 1.0), started(EVAL))
    append(folder, *(ViewEvaluated(EVAL, name, {"psnr": 21.5}) for name in names))
    append(folder, EvaluationSaved("eval/metrics.json", {"psnr": 21.5}), Delivered("web", 1, 1.0))
    append(folder, RunEnded(Outcome.DONE))
    driver.close()
    expect(page.locator("#status")).to_have_text("done")
    expect(page.locator("#block-table .pill[data-status='done']")).to_have_count(3)
    expect(page.locator("#facts")).to_contain_text("21.50 dB")
    expect(page.locator("#stages [data-status=done]")).to_have_count(7)
    expect(page.locator("#events")).to_contain_text("resumed the run")
    expect(page.locator("#view-source optgroup[label='Held-out views'] option")).to_have_count(2)
    page.locator("#view-source").select_option(label=names[0])
    expect(page.locator(".frames")).to_contain_text("held out: PSNR")
    page.get_by_text("Download", exact=True).click()
    with page.expect_download() as download:
        page.get_by_role("link", name="Raw PLY").click()
    assert Path(download.value.path()).read_bytes() == folder.point_cloud.read_bytes()
    with page.expect_download() as download:
        page.get_by_role("button", name="SOG").click()
    assert download.value.suggested_filename == f"{folder.root.name}.sog"
    assert len(read_model(saved(download.value, folder, "model.sog"))) == 30
    expect(page.get_by_role("link", name="Report")).to_be_visible()
    with page.expect_popup() as view:
        page.locator("#actions").get_by_role("button", name="3D view").click()
    view.value.wait_for_url(re.compile("/models/"))
    view.value.close()


def test_a_run_is_followed_and_steered_from_start_to_end(
    browser: Browser, driver: ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "town").mkdir()
    root = (tmp_path / "my runs").resolve()
    with ExitStack() as stack:
        server = stack.enter_context(serving(root))
        with opened(browser, server.url, tolerate=AWAY.search) as page:
            page.clock.install()
            page.reload()
            expect(page.locator("#empty")).to_contain_text("No run here yet")
            folder = write_run(root / "live", scene=str(tmp_path / "town"))
            began(folder, driver)
            append(folder, started(COARSE), *(progressed(COARSE, iteration) for iteration in range(1, 21)))
            page.get_by_role("link", name="live").click()
            stage_one_moves(page, folder)
            blocks_fill(page, folder)
            pause_and_go_on(page, folder)
            expect(page.locator("#facts")).to_contain_text("ETA")
            stack.close()
            the_server_goes(page)
            port = int(server.url.rpartition(":")[2])
            stack.enter_context(serving(root, port=port))
            expect(page.locator("#connection")).to_be_hidden()
            append(folder, progressed(FIRST, 77))
            expect(page.locator("#block-table tr[data-block='0']")).to_contain_text("77 / 100")
            the_driver_goes(page, folder, driver)
            os.mkfifo(said := tmp_path / "said")
            (program := tmp_path / "program").write_text(f'#!/bin/sh\necho "$@" > {said}\n')
            program.chmod(0o755)
            with monkeypatch.context() as patch:
                patch.setattr(sys, "executable", str(program))
                act(page, "Resume", "Resume the run?")
            assert said.read_text().endswith(f"; main() resume {folder.root}\n")
            began(folder, driver, resumed=True)
            append(folder, started(FIRST, 77), started(SECOND))
            expect(page.locator("#status")).to_have_text("running")
            all_is_done(page, folder, driver)
            page.get_by_role("link", name="All runs").click()
            expect(page.locator("#runs tbody .pill")).to_have_text("done")
