"""`panolog view`: what it serves and to whom, what it writes, and that it ends when it is stopped."""

import json
import os
import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import httpx
import numpy as np
import pytest

from panolog.export.reading import read_model
from panolog.orchestrator.cli.commands.view import SiteServer, site_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_folder
from panolog.scene.ply import read_ply
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.history import begun
from tests.orchestrator.watch.dashboard.served import raw
from tests.orchestrator.watch.views.models import save_model, save_plan
from tests.orchestrator.watch.views.sites import serving
from tests.scenes import write_scene


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run with a model and a scene whose panoramas are those of its plan."""
    names = [f"pano_{i}.jpg" for i in range(6)]
    write_scene(tmp_path / "scene", names=names)
    folder = begun(tmp_path / "a <run>", scene=tmp_path / "scene")
    save_model(folder, COARSE)
    save_plan(folder, names)
    return folder


def test_the_files_of_the_page_are_served_and_photographs_of_the_scene(folder: RunFolder) -> None:
    with site_of(folder.root, Wanted()) as site, serving(site) as address:
        with httpx.Client(base_url=address) as client:
            page = client.get("/")
            assert page.headers["content-type"] == "text/html; charset=utf-8"
            assert "default-src 'none'" in page.headers["content-security-policy"]
            assert client.get("/viewer.js").headers["content-type"].startswith("text/javascript")
            cameras = client.get("/scene.json").json()["cameras"]
            photograph = client.get(f"/{cameras[1]['photograph']}")
            assert (photograph.status_code, photograph.content[:3]) == (200, b"\xff\xd8\xff")
            size = len(client.get("/model.sog").content)
            assert client.head("/model.sog").headers["content-length"] == str(size)
            for path in ("photos/000006.jpg", "photos/1.jpg", "none", "photos", "photos/../scene.json/"):
                assert client.get(f"/{path}").status_code == 404
            (folder.root.parent / "scene" / "images" / "pano_2.jpg").write_text("no image")
            assert client.get("/photos/000002.jpg").status_code == 404
        assert site.folder.is_dir()
    assert not site.folder.exists()


def test_nothing_is_served_to_other_sites_and_from_other_folders(folder: RunFolder, tmp_path: Path) -> None:
    with site_of(folder.root, Wanted()) as site:
        (tmp_path / "secret").write_text("secret")
        (site.folder / "link").symlink_to(tmp_path / "secret")
        with serving(site) as address:
            url = address.rstrip("/")
            host = url.removeprefix("http://").encode()

            def answer(line: bytes, host: bytes = host) -> tuple[bytes, bytes]:
                """The status and all of an answer."""
                said = raw(url, line + b" HTTP/1.1\r\nHost: " + host + b"\r\nConnection: close\r\n\r\n")
                return said.split(b" ")[1], said

            outside = b"/../secret", b"/%2e%2e/secret", b"/link", b"//etc/passwd", b"/\x00", b"/%00", b"/."
            for path in outside:
                status, said = answer(b"GET " + path)
                assert status in (b"404", b"400"), path
                assert b"secret" not in said
            for other in (b"evil.example", b"127.0.0.1.evil.example", b""):
                assert answer(b"GET /", other)[0] == b"403", other
            assert answer(b"POST /")[0] == b"501"


def test_what_a_run_has_written_is_served_as_it_is_until_the_model_is_newer(folder: RunFolder) -> None:
    write_folder(site_of_run(folder, Wanted()), folder.web)
    with site_of(folder.root, Wanted()) as site:
        assert site.folder == folder.web
    with site_of(folder.root, Wanted(camera="pano_3.jpg")) as site:
        assert (site.folder, site.start) == (folder.web, "#camera=pano_3.jpg")
    for wanted in (Wanted(most=5), Wanted(task=COARSE)):
        with site_of(folder.root, wanted) as site:
            assert site.folder != folder.web
    later = time.time() + 100
    os.utime(folder.model(COARSE), (later, later))
    with site_of(folder.root, Wanted()) as site:
        assert site.folder != folder.web


@pytest.fixture
def browsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was opened in a browser, on a machine with windows."""
    opened: list[str] = []

    def open_page(url: str) -> bool:
        opened.append(url)
        return True

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("webbrowser.open", open_page)
    return opened


view = partial(call, "view")


@pytest.mark.parametrize(("up", "axis", "sign"), [(None, 1, 1), ("z", 2, -1), ("-z", 2, 1), ("x", 0, -1)])
def test_a_ply_with_another_up_stands_upright(
    up: str | None, axis: int, sign: int, folder: RunFolder, tmp_path: Path
) -> None:
    """Models of other programs lay on their side. In a SOG y is down."""
    given = [] if up is None else ["--up", up]
    assert view(folder.model(COARSE), *given, "-o", tmp_path / "page").exit_code == 0
    shown = np.sort(np.asarray(read_model(tmp_path / "page" / "model.sog").means)[:, 1])
    wanted = np.sort(sign * read_ply(folder.model(COARSE)).means[:, axis].numpy())
    np.testing.assert_allclose(shown, wanted, atol=0.02)


def test_up_is_of_a_ply(folder: RunFolder) -> None:
    assert "--up is of a PLY" in one_line(view(folder.root, "--up", "z"))
    assert "--up w: write 3 numbers" in one_line(view(folder.model(COARSE), "--up", "w"))


def test_the_command_writes_one_file_or_a_folder(folder: RunFolder, browsed: list[str]) -> None:
    page = folder.root / "out.html"
    for option in ("--max-gaussians", "--most"):
        done = view(folder.root, option, 5, "-o", page)
        assert (done.exit_code, done.stdout, browsed) == (0, f"{page.as_uri()}\n", [])
        assert done.stderr.endswith("5 of 20 Gaussians\n")
    assert page.is_file()
    done = view(folder.root, "-o", folder.root / "site")
    assert (done.exit_code, done.stdout, browsed) == (0, f"{folder.root / 'site'}\n", [])
    assert done.stderr.endswith(
        f"{folder.root.name}: has no merged model; this is its model of Stage I\n20 Gaussians\n"
    )
    assert len(list((folder.root / "site" / "photos").iterdir())) == 6
    done = view(folder.root / "site" / "model.sog", "-o", folder.root / "again")
    assert (done.exit_code, done.stderr) == (0, "")
    done = view(folder.root / "site" / "model.sog", "-o", page, "--max-gaussians", 5)
    assert done.stderr.endswith("5 of 20 Gaussians\n")


def test_the_command_serves_and_opens_the_page(
    folder: RunFolder, browsed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def serve_once(server: SiteServer, **_: object) -> None:
        seen.append(server.server_port)
        raise KeyboardInterrupt

    monkeypatch.setattr(SiteServer, "serve_forever", serve_once)
    done = view(folder.root, "--camera", "pano_1.jpg")
    assert done.exit_code == 0
    assert done.stdout == f"{browsed[0]}\n"
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", browsed[0])
    assert "20 Gaussians" in done.stderr
    assert done.stderr.endswith("Ctrl-C stops it\n")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    done = view(folder.root)
    assert (done.exit_code, len(browsed), len(seen)) == (0, 1, 2)
    assert f"there is no browser here: open the address elsewhere after ssh -L {seen[1]}:" in done.stderr


@pytest.mark.system
def test_sigterm_ends_the_command_and_leaves_nothing(folder: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "tmp").mkdir()
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "BROWSER")}
    command = [sys.executable, "-m", "panolog.orchestrator.cli", "view", str(folder.root)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment | {"TMPDIR": str(tmp_path / "tmp")}
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert json.loads(httpx.get(f"{url}scene.json").content)["title"] == "model of a <run>"
        process.terminate()
        assert process.wait(60) == 0
    assert list((tmp_path / "tmp").glob("panolog-view-*")) == []


def test_wrong_arguments_of_the_command(folder: RunFolder, browsed: list[str], tmp_path: Path) -> None:
    (damaged := tmp_path / "damaged.sog").write_bytes(b"no model")
    for wrong in (
        ["/none"],
        [tmp_path],
        [damaged, "-o", tmp_path / "page"],
        [folder.root, "--task", TaskId.block(9)],
        [folder.model(COARSE), "--task", COARSE],
        [folder.model(COARSE), "--camera", "pano_0.jpg"],
        [folder.root, "--camera", "none.jpg"],
        [folder.root, "-o", "/none/page.html"],
        [folder.root, "-o", folder.root / "page.html", "--max-gaussians", 2_000_000],
        [folder.root, "-o", folder.root],  # not a page: nothing there is replaced
    ):
        done = view(*wrong)
        assert (done.exit_code, done.stdout, browsed) == (2, "", []), wrong
        assert done.stderr.count("\n") == 1
    assert folder.info.is_file()
