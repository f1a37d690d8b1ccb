"""What is made of models: the 3D view, which can do nothing to the dashboard, and files to save."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from panolog.export.reading import read_model
from panolog.orchestrator.engine.stages.partitioning import write_plan
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.watch.dashboard.models import downloads, model_process, pages
from panolog.orchestrator.watch.dashboard.models.model_process import Maker
from panolog.orchestrator.watch.dashboard.models.pages import page_policy
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_folder
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_exported, read_ply, write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.dashboard.served import POST, SCORES, Served, plan, raw, serving, write_run
from tests.orchestrator.watch.views.models import save_checkpoint, save_snapshot, some
from tests.orchestrator.watch.views.sites import SIZE, layers, ready, shown, until, viewpoints_of
from tests.scenes import write_scene

TOKEN = "t" * 43
MODELS = "panolog.stage.app.root.children.filter((one) => one.name === 'model').length === 1"
FETCH = "fetch('/api/runs').then(() => 'answered', () => 'refused')"


def request_page(
    served: Served, task: str | None = None, camera: str | None = None, run: str = "run"
) -> httpx.Response:
    body = {"task": task, "camera": camera}
    return served.client.post(f"/api/runs/{served.id(run)}/viewer", json=body, headers=POST)


def url_of(served: Served, task: str | None = None, camera: str | None = None) -> str:
    answer = request_page(served, task, camera)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["url"])


def url_of_both(served: Served) -> str:
    """The address of a page that two clients have requested at once."""
    with ThreadPoolExecutor(2) as clients:
        first, second = clients.map(url_of, [served, served])
    assert first == second
    return first


def refused(served: Served, task: str | None = None, camera: str | None = None, run: str = "run") -> str:
    """The line of a request that gets no page."""
    answer = request_page(served, task, camera, run)
    assert answer.status_code == 409
    assert "\n" not in answer.json()["error"]
    return str(answer.json()["error"])


def save_model(folder: RunFolder, model: Gaussians) -> None:
    folder.of(COARSE).mkdir(exist_ok=True)
    write_ply(folder.model(COARSE), model)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run whose model is of opaque balls in front of one of its cameras."""
    folder = write_run(tmp_path_factory.mktemp("folder") / "run")
    write_plan(folder, plan(), SCORES)
    save_model(folder, layers(viewpoints_of(folder, "1.jpg")))
    return folder


@pytest.fixture(scope="module")
def served(folder: RunFolder) -> Iterator[Served]:
    """A server that requires a token, and a client that has it."""
    with pytest.MonkeyPatch.context() as patch, serving(folder.root.parent, token=TOKEN) as served:
        patch.setattr(model_process, "_IDLE_S", 0.2)  # its process ends with each test
        served.client.headers["Authorization"] = f"Bearer {TOKEN}"
        yield served


@pytest.mark.system
def test_a_page_draws_and_can_reach_nothing(browser: Browser, served: Served) -> None:
    def policy(text: str) -> bool:
        return "Content Security Policy" in text

    url = f"{served.url}{url_of_both(served)}#camera=1.jpg"
    with opened(browser, url, width=SIZE[0], height=SIZE[1], tolerate=policy) as page:
        assert len(np.unique(shown(page).reshape(-1, 3), axis=0)) > 1_000  # it is drawn
        assert page.title() == "model of run"
        assert page.evaluate("self.origin") == "null"
        assert page.evaluate(FETCH) == "refused"


@pytest.mark.system
def test_only_the_page_itself_is_granted_and_only_to_origins_of_their_own(served: Served) -> None:
    url = url_of(served)
    key = url.strip("/").split("/")[1]
    with httpx.Client(base_url=served.url) as anyone:
        for name in ("", "scene.json", "viewer.js", "engine.js", "model.sog"):
            answer = anyone.get(url + name)
            assert answer.status_code == 200
            assert answer.headers["access-control-allow-origin"] == "null"
            policy = page_policy(answer.request.url.netloc.decode(), key)
            assert answer.headers["content-security-policy"] == policy
        other = f"{key[:-1]}{(int(key[-1], 16) + 1) % 16:x}"
        for path in ("/", "/api/runs", f"/models/{other}/", f"/models/{key}A/", f"/models/{key}", "/models/"):
            assert anyone.get(path).status_code == 403, path
        assert anyone.post(url, headers=POST, content="{}").status_code in (403, 405)
    host = served.url.removeprefix("http://").encode()
    outside = ("..", "../..", "%2e%2e/%2e%2e", "../../api/runs", "/etc/passwd", "%00", "x/../../x", ".hidden")
    for path in outside:
        request = f"GET {url}{path} HTTP/1.1\r\nHost: ".encode() + host + b"\r\nConnection: close\r\n\r\n"
        assert raw(served.url, request).split(b" ")[1] in (b"403", b"404"), path


@pytest.mark.system
def test_a_page_is_made_once_for_all_cameras_and_clients(served: Served) -> None:
    assert url_of(served, camera="0.jpg") == f"{url_of_both(served)}#camera=0.jpg"
    for name in ("none.jpg", "../0.jpg", ""):
        assert refused(served, camera=name) == "the plan of this run has no such panorama"


def test_the_policy_names_the_pages_own_address_alone() -> None:
    own = page_policy("box.example:8360", "k" * 48)
    assert f"connect-src box.example:8360/models/{'k' * 48}/ data: blob:;" in own
    assert "'unsafe" not in own
    assert "sandbox allow-scripts allow-downloads;" in own
    for host in ("[::1]:8360", "x; script-src *", "", "a b", "x,y"):
        policy = page_policy(host, "k")
        assert host not in policy or not host
        assert "connect-src 'self' data: blob:;" in policy


@pytest.mark.system
def test_a_model_that_is_not_there_or_not_the_runs_own_is_a_line(tmp_path: Path) -> None:
    write_run(tmp_path / "folder" / "run")
    write_ply(tmp_path / "secret.ply", some(3))
    write_run(tmp_path / "folder" / "linked").point_cloud.symlink_to(tmp_path / "secret.ply")
    damaged = write_run(tmp_path / "folder" / "damaged")
    damaged.of(COARSE).mkdir()
    damaged.model(COARSE).write_bytes(b"nonsense")
    with serving(tmp_path / "folder") as served:
        for task in (None, "block/001", "../../etc"):
            assert refused(served, task)
        assert refused(served, camera="0.jpg")  # without a plan
        assert "not a plain file of the run" in refused(served, run="linked")
        line = refused(served, run="damaged")
        assert "model.ply: is not a model" in line and "/proc" not in line
        assert "was removed" in served.errors("/models/none/", 404)


@pytest.mark.system
def test_a_model_in_training_is_replaced_by_newer_ones_and_the_view_stays(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From its first picture on: upright, at a panorama, with cameras, before there is a plan."""
    monkeypatch.setattr(pages, "_REFRESH_S", 1)
    monkeypatch.setattr(pages, "_SHARE", 1e6)  # as soon as there is one
    monkeypatch.setattr(model_process, "_IDLE_S", 600)  # one process makes all pages
    folder = write_run(tmp_path / "run")
    folder.make(folder.outline.parent)
    write_json(folder.outline, plan().to_json())
    with lock.hold(folder.lock), serving(tmp_path) as served:
        page_of_run = f"/api/runs/{served.id('run')}"
        assert not served.get(page_of_run)["result"]["in_3d"]
        model = layers(viewpoints_of(folder))
        other = replace(model, sh0=-model.sh0)  # the same in other colours
        save_snapshot(folder, model)
        assert served.get(page_of_run)["result"]["in_3d"]
        url = served.url + url_of(served)
        first = httpx.get(f"{url}scene.json").json()
        assert (first["iteration"], first["total"], first["refresh"]) == (5, len(model), 1)
        assert [camera["name"] for camera in first["cameras"]] == [f"{number}.jpg" for number in range(4)]
        assert first["start"]["position"] in [camera["position"] for camera in first["cameras"]]
        with opened(browser, url, width=SIZE[0], height=SIZE[1]) as page:
            ready(page)
            count = page.locator("#count")
            expect(count).to_have_text(f"{len(model)} Gaussians · iteration 5")
            begun = shown(page)
            assert len(np.unique(begun.reshape(-1, 3), axis=0)) > 1_000
            save_checkpoint(folder, COARSE, 25, iteration=1_000)  # it has other details
            save_snapshot(folder, other, iteration=1_200)
            expect(count).to_have_text(f"{len(model)} Gaussians · iteration 1,200", timeout=300_000)
            until(page, MODELS)
            changed = np.abs(shown(page).astype(int) - begun).max(axis=2)
            drawn = np.abs(begun.astype(int) - begun[0, 0]).max(axis=2) > 60
            assert drawn.mean() > 0.05 and (changed[drawn] > 30).mean() > 0.8  # it is drawn at the same place
            bare = (begun == begun[0, 0]).all(axis=2)
            assert bare.mean() > 0.05 and (changed[bare] > 8).mean() < 0.02
            page.evaluate("panolog.flight.set({ position: [1, 2, 3], yaw: 40, pitch: 5 })")
            save_snapshot(folder, some(35, 2), iteration=1_300, most=21)
            expect(count).to_have_text("23 of 35 Gaussians · iteration 1,300", timeout=300_000)
            assert page.evaluate("[...panolog.flight.position, panolog.flight.yaw]") == [1, 2, 3, 40]
            save_model(folder, some(40))
            expect(count).to_have_text("40 Gaussians", timeout=300_000)
            until(page, MODELS)


@pytest.mark.system
def test_what_a_run_has_written_is_shown_with_the_scenes_photographs(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"{number}.jpg" for number in range(4)]
    write_scene(tmp_path / "scene", names=names)
    blue = bytes(cv2.imencode(".jpg", np.full((512, 1024, 3), (250, 20, 10), np.uint8))[1])
    (tmp_path / "scene" / "images" / "2.jpg").write_bytes(blue)
    folder = write_run(tmp_path / "run", scene=str(tmp_path / "scene"))
    write_plan(folder, plan(), SCORES)
    save_model(folder, some(400, sky=100))
    write_folder(site_of_run(folder, Wanted()), folder.web)
    (folder.web / "secret.txt").symlink_to(tmp_path / "scene" / "images" / "2.jpg")
    (program := tmp_path / "program").write_text("#!/bin/sh\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(program))  # nothing can be converted
    with serving(tmp_path) as served:
        url = url_of(served)
        served.errors(f"{url}secret.txt", 404)
        served.errors(f"{url}photos/000004.jpg", 404)
        with opened(browser, served.url + url, width=SIZE[0], height=SIZE[1]) as page:
            ready(page)
            page.evaluate("panolog.walk.go(panolog.walk.cameras[2])")
            page.click("#photograph")
            until(page, "panolog.walk._picture.opacity === 1")
            assert np.allclose(shown(page)[SIZE[1] // 2, SIZE[0] // 2], (250, 20, 10), atol=8)
        later = time.time() + 100
        os.utime(folder.model(COARSE), (later, later))  # a newer model needs another page
        assert refused(served) == "the 3D view could not be made"


@pytest.fixture
def small(tmp_path: Path) -> RunFolder:
    """A run with a model of thirty Gaussians."""
    folder = write_run(tmp_path / "runs" / "run")
    write_plan(folder, plan(), SCORES)
    write_ply(folder.point_cloud, some(30))
    return folder


def request(served: Served, kind: str) -> httpx.Response:
    path = f"/api/runs/{served.id('run')}/downloads"
    return served.client.post(path, json={"kind": kind}, headers=POST)


def saved(served: Served, kind: str, folder: Path) -> Path:
    """The file that the answer to a request leads to, saved."""
    answer = request(served, kind)
    assert answer.status_code == 200, answer.text
    file = served.client.get(answer.json()["url"])
    path = folder / file.headers["content-disposition"].partition("filename=")[2].strip('"')
    path.write_bytes(file.content)
    return path


@pytest.mark.system
def test_each_format_opens(small: RunFolder, tmp_path: Path) -> None:
    with serving(small.root.parent) as served:
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/sog", 404)  # nothing was requested
        sog, spz, ply, page = (saved(served, kind, tmp_path) for kind in ("sog", "spz", "ply", "html"))
    assert [path.name for path in (sog, spz, ply, page)] == [
        "run.sog",
        "run.spz",
        "run-upright.ply",
        "run.html",
    ]
    assert ply_exported(ply)
    down = np.sort(read_ply(ply).means[:, 1].numpy())
    assert len(down) == 30
    np.testing.assert_allclose(np.sort(read_model(sog).means[:, 1]), down, atol=0.01)
    np.testing.assert_allclose(np.sort(-read_model(spz).means[:, 1]), down, atol=0.01)
    assert b"engine.js" in page.read_bytes()


@pytest.mark.system
def test_a_file_is_made_once_for_each_model(
    small: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[str]()

    async def counted(_: Maker, module: str, arguments: list[str], what: str) -> float:
        made.append(arguments[2])
        Path(arguments[3]).write_bytes(small.point_cloud.read_bytes())
        return 0.0

    monkeypatch.setattr(Maker, "make", counted)  # what it makes: the test above
    with serving(small.root.parent) as served:
        first = saved(served, "ply", tmp_path).read_bytes()
        assert saved(served, "ply", tmp_path).read_bytes() == first
        assert made == ["ply"]
        write_ply(small.point_cloud, some(20))
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/ply", 404)  # that was the old model
        assert len(read_ply(saved(served, "ply", tmp_path))) == 20
        monkeypatch.setattr(downloads, "_CACHED", 1)
        saved(served, "spz", tmp_path)
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/ply", 404)


@pytest.mark.system
def test_what_cannot_be_made_is_one_line(small: RunFolder, tmp_path: Path) -> None:
    with serving(small.root.parent) as served:
        assert request(served, "exe").status_code == 422
        model = tmp_path / "outside.ply"
        small.point_cloud.rename(model)
        missing = request(served, "sog")
        assert (missing.status_code, missing.json()["error"]) == (409, "run: has no model yet")
        small.point_cloud.symlink_to(model)
        outside = request(served, "sog")
        assert (outside.status_code, outside.json()["error"]) == (
            409,
            "point_cloud.ply: is not a plain file of the run",
        )
        small.point_cloud.unlink()
        small.point_cloud.write_bytes(b"ply\n")
        damaged = request(served, "sog")
        assert damaged.status_code == 409
        assert damaged.json()["error"].startswith("point_cloud.ply: the PLY header is not terminated")
