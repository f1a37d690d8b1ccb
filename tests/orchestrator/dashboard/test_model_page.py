"""The 3D view of a run in a real browser: it draws, and what it runs can do nothing to the dashboard."""

import asyncio
import json
import os
import time
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from panolog.orchestrator.dashboard.discovery import RunEntry
from panolog.orchestrator.dashboard.model_pages import ModelPages, page_policy
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.stages.partitioning import write_plan
from panolog.orchestrator.views.site.build import Wanted, site_of_run, write_folder
from panolog.orchestrator.views.site.viewpoints import read_viewpoints
from panolog.scene.errors import InputError
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.browser import chromium, opened
from tests.orchestrator.dashboard.served import POST, Served, plan, raw, serving, write_run
from tests.orchestrator.views.models import some
from tests.orchestrator.views.pictures import layers, psnr, ready, rendered, shown, until
from tests.scenes import write_scene

TOKEN = "t" * 43
FETCH = "fetch('/api/runs').then(() => 'answered', () => 'refused')"


def request_page(served: Served, task: str | None = None, camera: str | None = None) -> httpx.Response:
    body = {"task": task, "camera": camera}
    path = f"/api/runs/{served.id('run')}/viewer"
    return served.client.post(path, json=body, headers=POST, timeout=120)


def url_of(served: Served, task: str | None = None, camera: str | None = None) -> str:
    answer = request_page(served, task, camera)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["url"])


def save_model(folder: RunFolder) -> None:
    folder.of(COARSE).mkdir(exist_ok=True)
    write_ply(folder.model(COARSE), some(400, sky=100))


@pytest.mark.system
@pytest.mark.parametrize("token", [None, TOKEN])
def test_a_model_is_drawn_by_a_page_that_can_reach_nothing(tmp_path: Path, token: str | None) -> None:
    save_model(write_run(tmp_path / "run"))
    with serving(tmp_path, token=token) as served, chromium() as browser:
        if token:
            served.client.headers["Authorization"] = f"Bearer {token}"
        url = served.url + url_of(served, "coarse")
        with opened(browser, url, tolerate=lambda text: "Content Security Policy" in text) as page:
            ready(page)
            assert page.title() == "coarse of run"
            picture = shown(page)
            assert (
                len(np.unique(picture[200:].reshape(-1, 3), axis=0)) > 1_000
            )  # a blurred model, no plain page
            assert page.evaluate("self.origin") == "null"
            assert page.evaluate(FETCH) == "refused"


@pytest.mark.system
def test_only_the_page_itself_is_granted_and_only_to_origins_of_their_own(tmp_path: Path) -> None:
    save_model(write_run(tmp_path / "run"))
    with serving(tmp_path, token=TOKEN) as served:
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        served.client.headers.update(bearer)
        url = url_of(served)
        key = url.strip("/").split("/")[1]
        with httpx.Client(base_url=served.url) as anyone:
            for name in ("", "scene.json", "viewer.js", "engine.js", "model.sog", "sky.jpg"):
                answer = anyone.get(url + name)
                assert answer.status_code == 200
                assert answer.headers["access-control-allow-origin"] == "null"
                assert answer.headers["content-security-policy"] == page_policy(
                    answer.request.url.netloc.decode(), key
                )
            for path in (
                "/",
                "/api/runs",
                f"/models/{key[:-1]}0/" if key[-1] != "0" else f"/models/{key[:-1]}1/",
                f"/models/{key.upper()}/" if key.upper() != key else "/models/x/",
                f"/models/{key}",
                "/models/",
            ):
                assert anyone.get(path).status_code == 403, path
            assert anyone.post(url, headers=POST, content="{}").status_code in (403, 405)
        host = served.url.removeprefix("http://").encode()
        for path in (
            "..",
            "../..",
            "%2e%2e/%2e%2e",
            "../../api/runs",
            "/etc/passwd",
            "%00",
            "x/../../x",
            ".hidden",
        ):
            request = f"GET {url}{path} HTTP/1.1\r\nHost: ".encode() + host + b"\r\nConnection: close\r\n\r\n"
            assert raw(served.url, request).split(b" ")[1] in (b"403", b"404"), path


def test_the_policy_names_the_pages_own_address_alone() -> None:
    own = page_policy("box.example:8360", "k" * 48)
    assert f"connect-src box.example:8360/models/{'k' * 48}/ data: blob:;" in own
    assert "'unsafe" not in own
    assert "sandbox allow-scripts allow-downloads;" in own
    for host in ("[::1]:8360", "x; script-src *", "", "a b", "x,y"):
        policy = page_policy(host, "k")
        assert host not in policy or not host
        assert "connect-src 'self' data: blob:;" in policy


def test_a_model_that_is_not_there_or_no_task_is_a_line(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    with serving(tmp_path) as served:
        for task in (None, "block/001", "../../etc"):
            answer = request_page(served, task)
            assert answer.status_code == 409
            assert "\n" not in answer.json()["error"]
        assert "was removed" in served.errors("/models/none/", 404)


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
        page.goto(served.url + url_of(served, camera="1.jpg"))
        picture = shown(page)
        assert page.evaluate("self.origin") == "null"
        quality = psnr(picture, rendered(model, viewpoints, (480, 320), background=picture[0, 0]))
        assert quality >= 25, f"{quality:.1f} dB"


@pytest.mark.system
def test_what_a_run_has_written_is_shown_with_the_scenes_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"{number}.jpg" for number in range(4)]
    write_scene(tmp_path / "scene", names=names)
    blue = bytes(cv2.imencode(".jpg", np.full((512, 1024, 3), (250, 20, 10), np.uint8))[1])
    (tmp_path / "scene" / "images" / "2.jpg").write_bytes(blue)
    folder = write_run(tmp_path / "run", scene=str(tmp_path / "scene"))
    write_plan(folder, plan())
    save_model(folder)
    write_folder(site_of_run(folder, Wanted()), folder.web)
    (folder.web / "secret.txt").symlink_to(tmp_path / "scene" / "images" / "2.jpg")
    with serving(tmp_path) as served, chromium() as browser:
        with monkeypatch.context() as patch:
            patch.setattr("sys.executable", "/nowhere/python")  # nothing is converted
            url = url_of(served)
        served.errors(f"{url}secret.txt", 404)
        served.errors(f"{url}photos/000004.jpg", 404)
        with opened(browser, served.url + url) as page:
            ready(page)
            page.evaluate("panolog.walk.go(panolog.walk.cameras[2])")
            until(page, "panolog.walk._picture.opacity === 1")
            picture = shown(page)
            assert np.allclose(picture[450, 720], (250, 20, 10), atol=8)
        later = time.time() + 100
        os.utime(folder.model(COARSE), (later, later))  # a newer model
        assert url_of(served) != url


@pytest.mark.system
def test_pages_are_made_once_and_kept_for_a_while(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    save_model(folder)
    place = RunEntry(tmp_path.resolve(), "run")

    async def check() -> None:
        pages = ModelPages()
        try:
            first, again = await asyncio.gather(pages.make(place, None, None), pages.make(place, None, None))
            assert first == again
            assert await pages.make(place, None, None) == first
            assert pages.grants(f"/models/{first}/viewer.js")
            for key in ("", "../x", first[:-1]):
                assert not pages.grants(f"/models/{key}/viewer.js")
            folder.model(COARSE).write_bytes(b"nonsense")
            with pytest.raises(InputError, match=r"model\.ply: is not a model") as caught:
                await pages.make(place, None, None)
            assert "/proc" not in str(caught.value)
            made = Path(pages._folder.name)
            assert len(list(made.iterdir())) == 1
        finally:
            pages.close()
        assert not made.exists()

    asyncio.run(check())


def test_a_page_shows_nothing_from_outside_the_run(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    secret = tmp_path / "secret.ply"
    write_ply(secret, some(3))
    folder.point_cloud.symlink_to(secret)
    place = RunEntry(tmp_path.resolve(), "run")

    async def check() -> None:
        pages = ModelPages()
        try:
            with pytest.raises(InputError, match="not a plain file of the run"):
                await pages.make(place, None, None)
        finally:
            pages.close()

    asyncio.run(check())
    assert json.loads(folder.info.read_text())
