"""Pages of models as folders and as single files: whole, of fixed bytes, and safe with any name."""

import base64
import json
import re
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from panolog.export.site import write
from panolog.export.site.page import Page, PageCamera, Pose, described
from panolog.export.site.write import site_files, write_page, write_site
from panolog.scene.errors import InputError

EVIL = '</script><script>alert("x")</script><!--\'&'
CAMERA = PageCamera(EVIL, Pose((1.0, 2.0, 3.0), 45.0), (0.0, 0.0, 0.0, 1.0))
PAGE = Page(
    EVIL, 20, start=Pose((0.0, 1.0, 2.0), 10.0, -5.0), cameras=(CAMERA,), step=2.0, sky=b"\xff\xd8 sky"
)


def model(folder: Path) -> str:
    (folder / "part").mkdir()
    (folder / "part" / "lod-meta.json").write_text("{}")
    return "part/lod-meta.json"


def contents(folder: Path) -> dict[str, bytes]:
    return {name: path.read_bytes() for name, path in site_files(folder).items()}


def test_the_engine_is_the_published_one_with_its_licence(tmp_path: Path) -> None:
    engine = Path(write.__file__).with_name("vendor") / "playcanvas.min.mjs"
    assert sha256(engine.read_bytes()).hexdigest() == write.ENGINE_SHA256
    assert f"PlayCanvas Engine v{write.ENGINE_VERSION} " in engine.read_text()[:200]
    write_site(tmp_path / "web", model, PAGE)
    assert sha256((tmp_path / "web" / "engine.js").read_bytes()).hexdigest() == write.ENGINE_SHA256
    licence = (tmp_path / "web" / "engine.LICENSE.txt").read_text()
    assert "Permission is hereby granted, free of charge" in licence


def test_a_folder_has_all_that_its_page_names(tmp_path: Path) -> None:
    write_site(tmp_path / "web", model, PAGE)
    written = contents(tmp_path / "web")
    html = written["index.html"].decode()
    linked = {name for name in re.findall(r'(?:src|href)="([^"]+)"', html) if not name.startswith("data:")}
    scripts = [
        text.decode() for name, text in written.items() if name.endswith(".js") and name != "engine.js"
    ]
    imported = {name for text in scripts for name in re.findall(r'from "\./([^"]+)"', text)}
    assert linked == {"engine.js", "viewer.css", "viewer.js"}
    assert linked | imported <= set(written)
    page = json.loads(written["scene.json"])
    assert {page["model"], page["sky"]} <= set(written)
    assert (page["title"], page["shown"], page["total"], page["step"]) == (EVIL, 20, 20, 2.0)
    assert page["start"] == {"position": [0.0, 1.0, 2.0], "yaw": 10.0, "pitch": -5.0}
    assert page["cameras"][0]["name"] == EVIL
    assert [path.name for path in tmp_path.iterdir()] == ["web"]


def test_the_same_page_is_the_same_bytes_and_replaces_its_former_self(tmp_path: Path) -> None:
    write_site(tmp_path / "web", model, PAGE)
    first = contents(tmp_path / "web")
    (tmp_path / "web" / "old").write_text("of a former version")
    write_site(tmp_path / "web", model, PAGE)
    assert contents(tmp_path / "web") == first
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, b"sog", PAGE)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_nothing_else_is_replaced_and_nothing_is_left_of_a_failure(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    (tmp_path / "file").write_text("mine")
    for name in ("mine", "link", "file"):
        with pytest.raises(InputError, match="is not a page of a model"):
            write_site(tmp_path / name, model, PAGE)
    write_site(tmp_path / "web", model, PAGE)
    before = contents(tmp_path / "web")

    def fails(folder: Path) -> str:
        (folder / "half").write_text("half")
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        write_site(tmp_path / "web", fails, PAGE)
    assert contents(tmp_path / "web") == before
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "link", "file", "web"}
    (tmp_path / "empty").mkdir()
    write_site(tmp_path / "empty", model, PAGE)


def test_one_file_names_nothing_outside_of_it_and_its_text_ends_no_element(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", b"\x00model\xff", PAGE)
    html = (tmp_path / "page.html").read_text()
    assert re.findall(r'(?:src|href)="(?!data:)', html) == []
    assert html.count("<script") == html.count("</script>") == 4
    assert f"<title>{EVIL}" not in html
    inside = dict(re.findall(r'<script type="[^"]+" id="(\w+)">(.*?)</script>', html, re.DOTALL))
    assert base64.b64decode(inside["model"]) == b"\x00model\xff"
    page = json.loads(inside["scene"])
    assert page["cameras"][0]["name"] == page["title"] == EVIL
    assert base64.b64decode(page["sky"].removeprefix("data:image/jpeg;base64,")) == PAGE.sky
    (urls,) = re.findall(r'<script type="importmap">(.*?)</script>', html, re.DOTALL)
    names = set(json.loads(urls)["imports"])
    texts = [base64.b64decode(url.partition(",")[2]).decode() for url in json.loads(urls)["imports"].values()]
    imported = {name for text in (*texts, html) for name in re.findall(r'from "(panolog/[^"]+)"', text)}
    assert imported == names
    assert not any(re.search(r'from "\./', text) for text in (*texts, html))
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_page(tmp_path / "other.html", b"", replace(PAGE, step=float("nan")))
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_poses_look_where_they_say() -> None:
    for yaw, pitch in ((0.0, 0.0), (90.0, 0.0), (-135.0, 30.0), (10.0, -80.0)):
        a, b = np.radians([yaw, pitch])
        ahead = np.array([-np.sin(a) * np.cos(b), np.sin(b), -np.cos(a) * np.cos(b)])
        pose = Pose.towards(np.array([1, 2, 3]), 5 * ahead)
        assert np.allclose([pose.yaw, pose.pitch], [yaw, pitch], atol=1e-3)


def test_a_description_gets_the_photographs_of_cameras_with_a_rotation() -> None:
    page = replace(PAGE, cameras=(CAMERA, replace(CAMERA, name="b", rotation=None)))
    data, names = described(json.dumps(page.as_json("model.sog", None)).encode())
    assert names == [EVIL, "b"]
    assert [camera["photograph"] for camera in json.loads(data)["cameras"]] == ["photos/000000.jpg", None]
    own = page.with_photographs(["x.jpg", "y.jpg"])
    assert [camera.photograph for camera in own.cameras] == ["x.jpg", None]


@pytest.mark.parametrize(
    "data", [b"", b"{}", b"[]", b'{"cameras": 3}', b'{"cameras": [1]}', b"[" * 100_000, b"\xff"]
)
def test_what_describes_no_page(data: bytes) -> None:
    with pytest.raises(InputError, match="does not describe a page"):
        described(data)
