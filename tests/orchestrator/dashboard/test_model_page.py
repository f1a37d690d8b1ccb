"""The 3D view of a run in a real browser: it draws, and what it runs can do nothing to the dashboard."""

from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.stages.partitioning import write_plan
from panolog.orchestrator.views.viewpoints import read_viewpoints
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.browser import chromium, opened
from tests.orchestrator.dashboard.served import POST, Served, plan, serving, write_run
from tests.orchestrator.views.pictures import layers, observe_sorting, psnr, rendered, shown
from tests.orchestrator.views.test_model_page import some

DRAWN = "document.querySelector('canvas') && performance.now() > 3000"
FETCH = "fetch('/api/runs').then(() => 'answered', () => 'refused')"


def request_page(served: Served, task: str | None = None, camera: str | None = None) -> httpx.Response:
    body = {"task": task, "camera": camera}
    return served.client.post(f"/api/runs/{served.id('run')}/viewer", json=body, headers=POST)


def url_of(served: Served, task: str | None = None, camera: str | None = None) -> str:
    answer = request_page(served, task, camera)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["url"])


def save_model(folder: RunFolder) -> None:
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), some(400, sky=100))


@pytest.mark.system
def test_a_model_is_drawn_by_a_page_that_can_reach_nothing(tmp_path: Path) -> None:
    save_model(write_run(tmp_path / "run"))
    with serving(tmp_path) as served, chromium() as browser:
        url = url_of(served, "coarse")
        with opened(browser, served.url + url, tolerate=lambda _: True) as page:
            page.wait_for_function(DRAWN)
            assert page.title() == "coarse of run"
            picture = np.asarray(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR))
            assert (
                len(np.unique(picture[200:].reshape(-1, 3), axis=0)) > 1_000
            )  # a blurred model, no plain page
            assert page.evaluate("self.origin") == "null"
            assert page.evaluate(FETCH) == "refused"


def test_a_model_that_is_not_there_or_no_task_is_a_line(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    with serving(tmp_path) as served:
        for task in (None, "block/001", "../../etc"):
            answer = request_page(served, task)
            assert answer.status_code == 409
            assert "\n" not in answer.json()["error"]
        assert "was removed" in served.errors("/models/none", 404)


@pytest.mark.system
def test_a_page_is_made_once_for_all_cameras(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    save_model(folder)
    with serving(tmp_path) as served:
        assert request_page(served, camera="0.jpg").status_code == 409  # without a plan
        write_plan(folder, plan())
        for name in ("none.jpg", "../0.jpg", ""):
            answer = request_page(served, camera=name)
            assert answer.status_code == 409
            assert answer.json()["error"] == "the plan of this run has no such panorama"
        assert url_of(served, camera="0.jpg") == f"{url_of(served)}#camera=0.jpg"


@pytest.mark.system
def test_the_picture_in_the_sandbox_is_that_of_our_renderer(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    write_plan(folder, plan())
    viewpoints = read_viewpoints(folder, None, "1.jpg")
    assert viewpoints is not None
    model = layers(viewpoints)
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), model)
    with serving(tmp_path) as served, chromium() as browser:
        page = browser.new_page(viewport={"width": 480, "height": 320})
        observe_sorting(page)
        page.goto(served.url + url_of(served, camera="1.jpg"))
        picture = shown(page)
        assert page.evaluate("self.origin") == "null"
        assert sorted(page.evaluate("sorted")) == list(range(len(model)))
        quality = psnr(picture, rendered(model, viewpoints, (480, 320), background=picture[0, 0]))
        assert quality >= 25, f"{quality:.1f} dB"
