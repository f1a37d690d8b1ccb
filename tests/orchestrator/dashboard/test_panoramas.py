"""The panoramas of a run's scene: small copies, and of nothing but the scene."""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import PreviewSaved
from panolog.workers.tasks import COARSE
from tests.orchestrator.dashboard.browser import PHONE, chromium, opened
from tests.orchestrator.dashboard.served import Served, append, serving, write_whole_run
from tests.scenes import write_scene
from tests.visual import legible

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
        picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
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


def no_scene(path: Path) -> None:
    path.write_bytes(b"")
    for file in (path.parents[1] / "sparse" / "0").iterdir():
        file.unlink()


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (bomb, "cannot be decoded"),
        (link_out, "a link that leads out of the scene"),
        (os.mkfifo, "is missing"),
        (lambda path: None, "is missing"),
        (lambda path: path.write_bytes(b"\xff\xd8\xff no picture"), "cannot be decoded"),
        (no_scene, "no COLMAP model"),
    ],
)
def test_what_is_no_panorama_of_the_scene_is_not_sent(
    tmp_path: Path, spoil: Callable[[Path], None], why: str
) -> None:
    scene, _ = of_scene(tmp_path)
    file = scene / "images" / "1.jpg"
    file.unlink()
    spoil(file)
    with serving(tmp_path / "folder") as server:
        assert why in server.errors(f"/api/runs/{server.id('run')}/camera/1/panorama", 404)


def test_a_name_that_leads_out_of_the_scene_is_refused(tmp_path: Path) -> None:
    scene, folder = of_scene(tmp_path)
    link_out(scene / "images" / "link.jpg")
    text = folder.plan.read_text()
    with serving(tmp_path / "folder") as server:
        for name in (
            "../../secret.jpg",
            "../../../secret.jpg",
            str(tmp_path / "secret.jpg"),
            "link.jpg",
            "\\u0000",
        ):
            folder.plan.write_text(text.replace("1.jpg", name))
            answer = server.client.get(f"/api/runs/{server.id('run')}/camera/1/panorama")
            assert answer.status_code == 404, name


@pytest.mark.system
@pytest.mark.parametrize("width", [PHONE, 1440])
def test_a_camera_shows_its_picture_and_a_block_its_cameras(served: Served, width: int) -> None:
    with chromium() as browser, opened(browser, served.url, width=width) as page:
        page.goto(f"{served.url}/runs/{served.id('run')}")
        expect(page.locator("#map-plot .heatmaplayer image").first).to_be_attached(timeout=20_000)
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
        assert legible.low_contrast(page) == legible.sideways(page) == []
