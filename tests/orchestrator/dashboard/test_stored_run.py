"""The dashboard of a run whose scene, or which itself, is in an object store."""

import os
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect

from panolog.orchestrator.dashboard import pictures
from panolog.orchestrator.run import lock
from panolog.orchestrator.storage.state import MirrorState, write_state
from panolog.orchestrator.views.site import photographs
from panolog.scene.read import read_scene
from panolog.scene.stores.cache import FOLDER
from tests.orchestrator.dashboard.browser import DESK, PHONE, chromium, opened
from tests.orchestrator.dashboard.served import serving, write_whole_run
from tests.orchestrator.dashboard.test_panoramas import NAMES, of_scene
from tests.visual import legible

PLACE = "s3://reconstructions-of-the-city/2026/street/run"


def stored_scene(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A scene in a store, with a run of it below `root`/folder. Returns its URL."""
    scene, _ = of_scene(root)
    noise = np.random.default_rng(0).integers(0, 256, (512, 1024, 3), np.uint8)
    noise[256:] = (200, 60, 20)  # is in the middle of the file, which an outline does not have
    for name in NAMES:
        cv2.imwrite(str(scene / "images" / name), noise)
    url = f"file://{scene}"
    write_whole_run(root / "folder" / "stored", url)
    monkeypatch.setenv(FOLDER, str(root / "cache"))
    return url


def test_a_panorama_in_a_store_comes_through_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = stored_scene(tmp_path, monkeypatch)
    with serving(tmp_path / "folder") as server:
        path = f"/api/runs/{server.id('stored')}/camera"
        assert "this machine has not read it yet" in server.get(f"{path}/1")["no_picture"]
        assert "has not read it yet" in server.errors(f"{path}/1/panorama", 404)
        read_scene(url)
        assert server.get(f"{path}/1")["no_picture"] is None
        for _ in range(2):  # fetched, then kept
            answer = server.client.get(f"{path}/1/panorama")
            picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None
            assert np.abs(picture[300:500].mean(axis=(0, 1)) - [200, 60, 20]).max() < 3
        assert len(list((tmp_path / "cache" / "objects").iterdir())) == 1
        os.utime(tmp_path / "scene" / "images" / "2.jpg", (1, 1))
        assert "has changed in the store" in server.errors(f"{path}/2/panorama", 404)
        monkeypatch.setattr(photographs, "_BYTES", 1000)
        assert "has more than 1,000 bytes" in server.errors(f"{path}/3/panorama", 404)
    assert len(list((tmp_path / "cache" / "objects").iterdir())) == 1


def test_a_store_that_fails_is_why_there_is_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_scene(stored_scene(tmp_path, monkeypatch))
    monkeypatch.setattr(pictures, "STORE_S", 0.1)
    (tmp_path / "scene" / "images" / "1.jpg").unlink()
    (tmp_path / "scene" / "images" / "1.jpg").symlink_to("1.jpg")  # cannot be read, and may pass
    with serving(tmp_path / "folder") as server:
        why = server.errors(f"/api/runs/{server.id('stored')}/camera/1/panorama", 404)
    assert "the store fails" in why


def test_an_outline_that_a_run_brings_along_fetches_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = read_scene(stored_scene(tmp_path, monkeypatch)).root
    brought = tmp_path / "other" / made.name
    shutil.copytree(made, brought)
    write_whole_run(tmp_path / "folder" / "brought", str(brought))
    with serving(tmp_path / "folder") as server:
        server.client.get(f"/api/runs/{server.id('brought')}/camera/1/panorama")
    assert not (tmp_path / "cache" / "objects").exists()


@pytest.mark.system
@pytest.mark.parametrize("width", [PHONE, DESK])
def test_how_far_a_store_is_behind_is_legible(tmp_path: Path, width: int) -> None:
    why = f"{PLACE}/.panolog/objects/blocks/000/checkpoint.safetensors/18b2: the store fails (Slow down.)"
    late = MirrorState(
        PLACE, "m", since=time.time() - 1500, pending_files=12, pending_bytes=2**33, problem=why
    )
    folder = write_whole_run(tmp_path / "folder" / "late", "/nowhere")
    write_state(folder.mirror, late)
    with (
        lock.hold(folder.lock),
        serving(tmp_path / "folder") as server,
        chromium() as browser,
        opened(browser, server.url, width=width) as page,
    ):
        page.goto(f"{server.url}/runs/{server.id('late')}")
        fact = page.locator("#facts div", has_text="Object store")
        expect(fact).to_contain_text("12 files (8.0 GiB) to go")
        expect(fact).to_contain_text("Slow down.")
        assert legible.low_contrast(page) == legible.sideways(page) == []
