"""The panoramas of a run's scene, also of one in a store: small copies, and of nothing but the scene."""

import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import PreviewSaved
from panolog.orchestrator.watch.dashboard import pictures
from panolog.orchestrator.watch.views.site import photographs
from panolog.scene.read import read_scene
from panolog.scene.stores.cache import FOLDER
from panolog.workers.tasks import COARSE
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard.browser import PHONE, opened
from tests.orchestrator.watch.dashboard.served import Served, serving, write_whole_run
from tests.scenes import write_scene
from tests.visual.compare import expand

NAMES = [f"{number}.jpg" for number in range(4)]  # as in the plan of `write_whole_run`


def of_scene(root: Path) -> tuple[Path, RunFolder]:
    """A scene, and below `root`/folder a run of it."""
    scene = write_scene(root / "scene", names=NAMES)
    return scene, write_whole_run(root / "folder" / "run", str(scene))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    scene, folder = of_scene(tmp_path)
    cv2.imwrite(str(scene / "images" / "1.jpg"), np.full((1024, 2048, 3), (200, 60, 20), np.uint8))
    append(folder, PreviewSaved(COARSE, 100, "1.jpg", "coarse/previews/000050.jpg"))
    with serving(tmp_path / "folder") as server:
        yield server


def test_a_panorama_is_sent_small(served: Served) -> None:
    path = f"/api/runs/{served.id('run')}/camera/1"
    assert served.get(path)["no_picture"] is None
    for _ in range(2):  # made, then from the cache
        answer = served.client.get(f"{path}/panorama")
        assert answer.headers["content-type"] == "image/jpeg"
        picture = expand(answer.content)
        assert picture.shape == (512, 1024, 3)
        assert np.abs(picture.mean(axis=(0, 1)) - [200, 60, 20]).max() < 3


def bomb(path: Path) -> None:
    """A PNG that would have 50 gigabytes of pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 131_072, 131_072, 8, 2, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(10_000))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def link_out(path: Path) -> None:
    secret = path.parents[2] / "secret.jpg"
    cv2.imwrite(str(secret), np.zeros((8, 16, 3), np.uint8))
    path.symlink_to(secret)


def test_what_is_no_panorama_of_the_scene_is_not_sent(tmp_path: Path) -> None:
    scene, folder = of_scene(tmp_path)
    file, plan = scene / "images" / "1.jpg", folder.plan.read_text()
    spoils: dict[Callable[[Path], object], str] = {
        bomb: "cannot be decoded",
        link_out: "a link that leads out of the scene",
        os.mkfifo: "is missing",
        lambda path: None: "is missing",
        lambda path: path.write_bytes(b"\xff\xd8\xff no picture"): "cannot be decoded",
    }
    with serving(tmp_path / "folder") as server:
        path = f"/api/runs/{server.id('run')}/camera/1/panorama"
        for spoil, why in spoils.items():
            file.unlink(missing_ok=True)
            spoil(file)
            assert why in server.errors(path, 404)
        for name in ("../../secret.jpg", "../../../secret.jpg", str(tmp_path / "secret.jpg"), "\\u0000"):
            folder.plan.write_text(plan.replace("1.jpg", name))
            assert server.errors(path, 404), name
        folder.plan.write_text(plan)
        for model in (scene / "sparse" / "0").iterdir():
            model.unlink()
        assert "no COLMAP model" in server.errors(path, 404)


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
            picture = expand(server.client.get(f"{path}/1/panorama").content)
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
def test_a_camera_shows_its_picture_and_a_block_its_cameras(browser: Browser, served: Served) -> None:
    with opened(browser, f"{served.url}/runs/{served.id('run')}", width=PHONE) as page:
        expect(page.locator("#map-plot .points")).to_be_attached()
        page.locator("#block-table tr[data-block='1'] button").click()
        panel = page.locator("#selected")
        expect(panel.locator("summary")).to_have_text("3 cameras: 1 by gradient, 2 by geometry and gradient")
        panel.get_by_role("button", name="1.jpg").click()
        expect(panel.locator("h3")).to_have_text("1.jpg")
        loaded = "(node) => node.decode().then(() => node.naturalWidth)"
        expect(panel.locator("figure")).to_have_count(2)
        expect(panel.get_by_role("button", name="Stage I, iteration 100")).to_be_visible()
        assert panel.locator("img").first.evaluate(loaded) == 1024
        expect(panel.get_by_role("button", name="Open in 3D from here")).to_be_enabled()
