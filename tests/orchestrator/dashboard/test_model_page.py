"""The 3D view of a run in a real browser: it draws, and what it runs can do nothing to the dashboard."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.browser import chromium, opened
from tests.orchestrator.dashboard.served import POST, Served, serving, write_run
from tests.orchestrator.views.test_model_page import some

DRAWN = "document.querySelector('canvas') && performance.now() > 3000"
FETCH = "fetch('/api/runs').then(() => 'answered', () => 'refused')"


def url_of(served: Served, task: str | None = None) -> str:
    answer = served.client.post(f"/api/runs/{served.id('run')}/viewer", json={"task": task}, headers=POST)
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
            body = {"task": task}
            answer = served.client.post(f"/api/runs/{served.id('run')}/viewer", json=body, headers=POST)
            assert answer.status_code == 409
            assert "\n" not in answer.json()["error"]
        assert "was removed" in served.errors("/models/none", 404)
