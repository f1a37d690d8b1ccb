"""A run that makes its scene: what its page shows meanwhile, and what it believes of files in RUN/prepare."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.info import PENDING, make_info, read_info, write_info
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.notes import Counts, StepProgress, StepResult
from panolog.orchestrator.runs.preparation.settings import Settings, Step, write_settings
from panolog.orchestrator.runs.records import Outcome, Preparing, RunBegan, RunEnded
from panolog.orchestrator.runs.state import replay
from panolog.orchestrator.watch.views.preparation import view_preparation
from panolog.orchestrator.watch.views.timing import progress_of
from panolog.workers.tasks import PREPARE
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.browser import PHONE, opened
from tests.orchestrator.watch.dashboard.served import EVIL, POST, Served, serving, write_run
from tests.visual import legible

COUNTS = Counts(panoramas=12, registered=10, points=3_000, weak_links=0, contradictions=2)


def write_preparing(root: Path, lines: tuple[str, ...] = ("10 of 12 panoramas have a pose",)) -> RunFolder:
    """A run of a video whose poses are found."""
    folder = write_run(root, [RunBegan("host", 1, resumed=False), Preparing("finding poses", PREPARE)])
    info = read_info(folder)
    scene = info.scene.model_copy(update={"path": str(folder.scene), "fingerprint": PENDING})
    write_info(folder, make_info(scene, info.config))
    settings = Settings(
        source=f"/{EVIL}.mp4", video=True, panoramas=900, width=64, nadir=0, static=False, depth_model="m"
    )
    write_settings(folder, settings)
    found = StepResult(step=Step.SFM, settings={}, seconds=60, lines=lines, counts=COUNTS)
    notes.write_note(folder.step_result(Step.SFM), found)
    note(folder, 3)
    folder.scene.mkdir()
    cv2.imwrite(str(folder.sfm_picture), np.full((40, 60, 3), 255, np.uint8))
    return folder


def note(folder: RunFolder, done: int) -> None:
    progress = StepProgress(step=Step.DEPTH, what="depth", done=done, total=10)
    notes.write_note(folder.preparation_progress, progress)


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return write_preparing(tmp_path / "runs" / "walk", ("10 of 12 panoramas have a pose", EVIL))


@pytest.fixture
def served(folder: RunFolder) -> Iterator[Served]:
    with serving(folder.root.parent) as server:
        yield server


def test_the_preparation_is_shown_while_it_is_at_work(folder: RunFolder, served: Served) -> None:
    path = f"/api/runs/{served.id('walk')}"
    with lock.hold(folder.lock):
        page = served.get(path)
        assert page["summary"]["step"] == "depth 3 of 10"
        made = page["preparation"]
        assert page["stages"][0]["progress"] == made["progress"]
        assert 0 < page["progress"] == made["over"] < made["progress"] < 1
        assert [step["status"] for step in page["preparation"]["steps"]] == ["done", "running", "waiting"]
        (row,) = served.get("/api/runs")["runs"]
        assert (row["status"], row["label"], row["stage"]) == ("running", "preparing", "prepare")
    stopped = served.get(path)
    assert [step["status"] for step in stopped["preparation"]["steps"]] == ["done", "stopped", "waiting"]
    assert stopped["stages"][0]["status"] == "stopped"


def test_its_pictures_are_sent(folder: RunFolder, served: Served) -> None:
    path = f"/api/runs/{served.id('walk')}"
    (picture,) = served.get(path)["preparation"]["pictures"]
    answer = served.client.get(f"{path}/preparation/{picture['name']}")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/png")
    assert served.client.get(f"{path}/preparation/masks").status_code == 404
    assert served.client.get(f"{path}/preparation/..%2Frun.json").status_code == 404
    folder.masks_picture.write_bytes(b"<svg onload=alert(1)>")
    assert served.client.get(f"{path}/preparation/masks").status_code == 404
    folder.sfm_picture.unlink()
    folder.sfm_picture.symlink_to("/etc/hostname")
    assert served.client.get(f"{path}/preparation/sfm").status_code == 404


def link(path: Path) -> None:
    secret = path.parents[3] / "secret.json"
    path.rename(secret)
    path.symlink_to(secret)


def test_files_made_to_do_harm_show_nothing(tmp_path: Path) -> None:
    """All that is no plain file of a run: tests/orchestrator/runs/test_folder.py."""
    spoils: dict[str, Callable[[Path], object]] = {"link": link, "damaged": lambda it: it.write_bytes(b"{")}
    for name, spoil in spoils.items():
        spoil(write_preparing(tmp_path / "runs" / name).preparation_settings)
        spoil(write_preparing(tmp_path / "runs" / f"{name} progress").preparation_progress)
    with serving(tmp_path / "runs") as server:
        for run in server.get("/api/runs")["runs"]:
            page = server.get(f"/api/runs/{run['id']}")
            if run["name"].endswith("progress"):
                steps = page["preparation"]["steps"]
                assert [step["status"] for step in steps] == ["done", "waiting", "waiting"], run
            else:
                assert page["preparation"] is None, run
                assert page["summary"]["status"] == "stopped"


def test_a_run_without_its_scene_can_be_resumed_only_if_it_makes_it(
    folder: RunFolder, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(folder, RunEnded(Outcome.INTERRUPTED))
    folder.sfm_picture.unlink()
    folder.scene.rmdir()
    folder.preparation_settings.rename(folder.root / "away.json")
    monkeypatch.setattr("sys.executable", "/bin/true")
    path = f"/api/runs/{served.id('walk')}/actions"
    assert served.client.post(path, json={"action": "resume"}, headers=POST).status_code == 409
    (folder.root / "away.json").rename(folder.preparation_settings)
    append(folder, RunBegan(os.uname().nodename, 1, resumed=True), RunEnded(Outcome.INTERRUPTED))
    before = psutil.Process().children()
    assert served.client.post(path, json={"action": "resume"}, headers=POST).status_code == 202
    started = [it for it in psutil.Process().children() if it not in before]
    assert psutil.wait_procs(started, timeout=120)[1] == []


@pytest.mark.system
def test_the_page_has_steps_numbers_pictures_and_then_exposures(
    browser: Browser, folder: RunFolder, served: Served
) -> None:
    url, path = (f"{served.url}/runs/{served.id('walk')}", f"/api/runs/{served.id('walk')}/exposure")
    assert served.client.get(path).status_code == 404
    with lock.hold(folder.lock), opened(browser, url, width=PHONE) as page:
        card = page.locator("#preparation")
        running = card.locator(".step[data-status='running'] .step-note")
        expect(running).to_have_text("running · depth 3 of 10")
        expect(page.locator("#exposure")).to_be_hidden()
        note(folder, 9)
        expect(running).to_have_text("running · depth 9 of 10")
        expect(card).to_contain_text(EVIL)
        expect(card.locator("#kept")).to_contain_text("Without a pose2")
        expect(card.locator("img")).to_have_js_property("naturalWidth", 60)
        known = [
            {"name": EVIL, "stops": at / 4, "gain": [1.0, 1.1, 1.2], "black": [0, 0, 0]} for at in range(5)
        ]
        write_json(folder.root / "exposure.json", {"panoramas": known})
        expect(page.locator("#exposure-plot .scatterlayer .trace")).to_have_count(4)
        assert legible.hard_to_read(page, PHONE) == []


def test_the_progress_of_a_run_grows_with_each_part_of_the_preparation(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", [RunBegan("host", 1, resumed=False), Preparing("masks", PREPARE)])
    write_settings(
        folder, Settings(source="/walk.mp4", video=True, panoramas=9, width=64, nadir=9, static=True)
    )
    state, found = replay(read_milestones(folder.database)), list[float]()

    def show(step: Step, what: str, done: int = 0, total: int = 0) -> None:
        written = StepProgress(step=step, what=what, done=done, total=total)
        notes.write_note(folder.preparation_progress, written)
        view = view_preparation(folder, state, running=True)
        assert view is not None
        found.append(progress_of(state, 9.0, view.over))

    show(Step.SFM, "finding poses and points")
    show(Step.SFM, "frames", 3, 9)
    show(Step.SFM, "metadata", 9, 9)
    show(Step.MASKS, "masking")
    show(Step.MASKS, "static regions", 9, 9)
    show(Step.MASKS, "masks", 4, 9)
    done = StepResult(step=Step.MASKS, settings={}, seconds=1, lines=())
    notes.write_note(folder.step_result(Step.MASKS), done)
    show(Step.SFM, "finding poses and points")
    for part in ("features", "look-alikes", "matches", "poses", "scene"):
        show(Step.SFM, part, 5, 9)
    assert found == sorted(found) and len(set(found)) >= 10
    assert found[0] == 0
