"""Pages of runs in 3D: what they show and from where; in a browser: measuring, streaming, what goes wrong."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, expect
from scipy.spatial.transform import Rotation

from panolog.export.frame import Frame
from panolog.export.georeference import Georeference
from panolog.export.splats import InMemory, Selection, Splats
from panolog.export.spz import read_spz, write_spz
from panolog.orchestrator.runs.folder import RunFolder, model_of, write_json
from panolog.orchestrator.watch.views.site import build
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_file, site_of_run, write_folder
from panolog.orchestrator.watch.views.site.photographs import panorama_rotations, photograph
from panolog.orchestrator.watch.views.site.source import open_model
from panolog.orchestrator.watch.views.site.viewpoints import read_viewpoints
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import write_ply, write_ply_parts
from panolog.scene.read import read_scene
from panolog.workers.tasks import COARSE, TaskId
from tests.export.gaussians import scattered
from tests.orchestrator.history import begun
from tests.orchestrator.watch.dashboard.browser import opened, program
from tests.orchestrator.watch.views.models import save_checkpoint, save_model, save_plan, some
from tests.orchestrator.watch.views.sites import (
    SIZE,
    balls,
    cloud,
    psnr,
    ready,
    rendered,
    run_with,
    serving,
    shown,
    until,
    viewpoints_of,
)
from tests.scenes import write_scene


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run that has not begun."""
    return begun(tmp_path / "a <run>")


def written(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "scene.json").read_text())
    return content


def test_a_page_begins_at_the_panorama_that_is_named(folder: RunFolder) -> None:
    with pytest.raises(InputError, match="has no cameras yet"):
        read_viewpoints(folder, None, "0.jpg")
    assert read_viewpoints(folder, None) is None
    save_plan(folder)
    found = read_viewpoints(folder, None, "3.jpg")
    assert found is not None
    assert list(found.cameras) == [f"{i}.jpg" for i in range(6)]
    assert found.start is found.cameras["3.jpg"]
    assert found.start.position.tolist() == [3, 5, 1]
    assert np.allclose(found.start.ahead, np.array([1, 0, -1]) / 2**0.5)  # towards the next
    assert np.allclose(found.cameras["5.jpg"].ahead, np.array([1, 0, 1]) / 2**0.5)
    assert found.up.tolist() == [0, -1, 0]
    of_block = read_viewpoints(folder, TaskId.block(0), "5.jpg")
    assert of_block is not None
    assert "5.jpg" not in of_block.cameras  # what does not train the block can still be the start
    assert of_block.start.position.tolist() == [5, 5, 1]


def test_without_a_plan_the_cameras_are_those_of_the_scene(tmp_path: Path) -> None:
    """A run with refine=false has no plan, and had no cameras."""
    folder = begun(tmp_path / "run", scene=tmp_path / "scene")
    assert read_viewpoints(folder, None) is None  # its scene is not here
    scene = read_scene(write_scene(tmp_path / "scene"))
    found = read_viewpoints(folder, None)
    assert found is not None
    assert list(found.cameras) == [scene.panoramas[row].name for row in scene.train]
    first = scene.panoramas[scene.train[0]]
    assert np.allclose(found.cameras[first.name].position, first.center)
    held_out = scene.panoramas[scene.test[0]]
    begins = read_viewpoints(folder, None, held_out.name)
    assert begins is not None
    assert np.allclose(begins.start.position, held_out.center)
    assert read_viewpoints(folder, None, locate=lambda path: path) is None


def test_a_panorama_that_is_held_out_comes_from_the_scene(tmp_path: Path) -> None:
    folder = begun(tmp_path / "run", scene=tmp_path / "scene")
    save_plan(folder)
    with pytest.raises(InputError, match=r"^camera 1\.png: is not in the run's plan, and its scene: "):
        read_viewpoints(folder, None, "1.png")
    write_scene(tmp_path / "scene")
    panorama = read_scene(tmp_path / "scene").panoramas[0]
    found = read_viewpoints(folder, None, panorama.name)
    assert found is not None
    assert np.allclose(found.start.position, panorama.center)
    level = panorama.rotation[2] * [1, 0, 1]
    assert np.allclose(found.start.ahead, level / np.linalg.norm(level))
    with pytest.raises(InputError, match=r"^camera none: the run has no such panorama; one is \d\.jpg$"):
        read_viewpoints(folder, None, "none")
    with pytest.raises(InputError, match=r"no such panorama; one is 1\.jpg"):
        read_viewpoints(folder, None, "1.jpeg", locate=lambda path: path)


def test_the_current_model_is_the_latest_there_is(folder: RunFolder) -> None:
    with pytest.raises(InputError, match="the run has no model yet"):
        model_of(folder)
    save_checkpoint(folder, COARSE)
    assert model_of(folder) == folder.checkpoint(COARSE)
    save_model(folder, COARSE)
    assert model_of(folder) == folder.model(COARSE)
    with pytest.raises(InputError, match="block/001 has no model yet"):
        model_of(folder, TaskId.block(1))
    with pytest.raises(InputError, match="score/000 is not a task that trains"):
        model_of(folder, TaskId.shard(0))
    for path in ("../x", "block/../../x", "block/000\n", "coarse/.."):
        with pytest.raises(InputError, match="is not a task"):
            TaskId.parse(path)
    write_ply(folder.point_cloud, some(3))
    assert model_of(folder) == folder.point_cloud


def test_a_checkpoint_becomes_a_page_of_its_cameras(folder: RunFolder, tmp_path: Path) -> None:
    save_checkpoint(folder, TaskId.block(0))
    save_plan(folder)
    shown = site_of_run(folder, Wanted(TaskId.block(0), most=7))
    write_folder(shown, tmp_path / "web")
    page = written(tmp_path / "web")
    assert page["title"] == "block/000 of a <run>"
    assert (page["shown"], page["total"], page["model"], page["sky"]) == (9, 20, "model.sog", "sky.jpg")
    assert [camera["name"] for camera in page["cameras"]] == [f"{i}.jpg" for i in range(3)]
    assert all(camera["photograph"] is None for camera in page["cameras"])  # without the scene
    assert page["step"] == pytest.approx(2**0.5)
    assert shown.scene is None


def test_the_world_is_turned_so_that_y_is_up(folder: RunFolder) -> None:
    save_model(folder, COARSE)
    save_plan(folder)
    cameras = site_of_run(folder, Wanted()).page.cameras
    # the world's y is down; the origin is the middle of the cameras in whole units: (2, 5, 0)
    assert cameras[3].pose.position == (1.0, 0.0, -1.0)
    assert cameras[3].pose.yaw == pytest.approx(-135)  # towards +x and, as z is turned, +z
    place = {"up": [0, 0, 1], "offset": [0, 0, 0], "origin": None, "epsg": None, "metres_per_unit": 2.5}
    exports = {"origin": [1.0, 0.0, 0.0]}
    write_json(folder.georeference, {"version": 1, "model": place, "exports": exports, "provenance": {}})
    page = site_of_run(folder, Wanted()).page
    assert page.cameras[3].pose.position == (2.0, 1.0, -5.0)
    assert page.metres_per_unit == 2.5
    assert page.as_json("model.sog", None)["frame"]["rotation"] == [
        [1, 0, 0],
        [0, 0, 1],
        [0, -1, 0],
    ]  # z is up
    for wrong in ("nonsense", "[]", "[" * 100_000):
        folder.georeference.write_text(wrong)
        with pytest.raises(InputError, match=r"georef\.json: .*remove it"):
            site_of_run(folder, Wanted())


def test_photographs_are_small_and_turned_like_their_panoramas(tmp_path: Path) -> None:
    names = [f"pano_{i}.jpg" for i in range(6)]
    write_scene(tmp_path / "scene", names=names)
    folder = begun(tmp_path / "run", scene=tmp_path / "scene")
    save_model(folder, COARSE)
    save_plan(folder, names)
    shown = site_of_run(folder, Wanted())
    steps: list[tuple[str, int, int]] = []
    write_folder(shown, tmp_path / "web", lambda *step: steps.append(step))
    cameras = written(tmp_path / "web")["cameras"]
    assert [camera["photograph"] for camera in cameras] == [f"photos/{i:06d}.jpg" for i in range(6)]
    assert (tmp_path / "web" / cameras[5]["photograph"]).read_bytes().startswith(b"\xff\xd8\xff")
    assert ("photographs", 6, 6) in steps
    panorama = read_scene(tmp_path / "scene").panoramas[2]
    turned = Rotation.from_quat(cameras[2]["rotation"]).as_matrix()
    assert np.allclose(turned @ [0, 0, 1], np.diag([1, -1, -1]) @ panorama.rotation[2], atol=1e-5)


def test_photographs_come_from_the_scene_alone(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    with pytest.raises(InputError, match="is not on this machine"):
        panorama_rotations(Path("relative"), [])
    assert list(panorama_rotations(scene, ["pano_1.jpg", "none.jpg"])) == ["pano_1.jpg"]
    (tmp_path / "secret.jpg").write_bytes((scene / "images" / "pano_0.jpg").read_bytes())
    (scene / "images" / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    (scene / "images" / "text.jpg").write_text("no image")
    for name in ("../../secret.jpg", "link.jpg", "none.jpg", "text.jpg"):
        with pytest.raises(InputError) as caught:
            photograph(scene, name)
        assert "\n" not in str(caught.value)


def test_a_large_model_is_streamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "STREAMED_FROM", 100)
    write_ply(tmp_path / "model.ply", some(150))
    write_folder(site_of_file(tmp_path / "model.ply", Wanted()), tmp_path / "web")
    page = written(tmp_path / "web")
    assert page["model"] == "model/lod-meta.json"
    assert json.loads((tmp_path / "web" / page["model"]).read_text())["lodLevels"] >= 1
    write_folder(site_of_file(tmp_path / "model.ply", Wanted(most=100)), tmp_path / "web")
    assert written(tmp_path / "web")["model"] == "model.sog"


def test_what_is_no_model_or_has_no_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "model"
    for content in (b"", b"ply\nformat ascii 1.0\n", b"\x10" + bytes(7) + b"{" + bytes(20)):
        path.write_bytes(content)
        with pytest.raises((InputError, RunError)):
            site_of_file(path, Wanted())
    write_ply_parts(tmp_path / "model.ply", [], count=0, sky=0)
    with pytest.raises(InputError, match="has no Gaussians to show"):
        site_of_file(tmp_path / "model.ply", Wanted())


def test_a_model_of_sky_alone_is_shown(tmp_path: Path) -> None:
    write_ply(tmp_path / "sky.ply", some(9, sky=9))
    page = site_of_file(tmp_path / "sky.ply", Wanted()).page
    assert (page.total, page.sky) == (9, None)


def test_an_spz_is_upright_whatever_its_name(tmp_path: Path) -> None:
    """In an SPZ y is up, and in what pages show y is down."""
    for name in ("model.spz", "model"):
        write_spz(tmp_path / name, InMemory(scattered(30)))
        (piece,) = open_model(tmp_path / name, Frame(), Selection()).scene.pieces()
        assert np.allclose(piece.means, read_spz(tmp_path / name).means * (-1, -1, 1))


def test_the_sky_of_an_spz_is_next_to_it(tmp_path: Path) -> None:
    write_spz(tmp_path / "place.spz", InMemory(scattered(30)))
    assert site_of_file(tmp_path / "place.spz", Wanted()).page.sky is None
    write_spz(tmp_path / "place-sky.spz", InMemory(scattered(9)))
    page = site_of_file(tmp_path / "place.spz", Wanted()).page
    assert (page.total, page.sky is None) == (39, False)
    frame = Georeference().upside_down
    sky = open_model(tmp_path / "place.spz", frame, Selection()).sky
    assert sky is not None
    shown = Splats.of(sky).turned(frame).means
    assert np.allclose(shown, read_spz(tmp_path / "place-sky.spz").means * (-1, -1, 1), atol=1e-5)


WIDTH, HEIGHT = 800, 500  # pixels of a window


def measuring_run(root: Path, metres: float | None) -> Path:
    """The page of two balls, two units apart, five units ahead of the first panorama."""
    folder = begun(root / "run")
    save_plan(folder)
    viewpoints = viewpoints_of(folder, "0.jpg")
    places = torch.tensor([[-1.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0, 3.0, 30.0]])
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), balls(viewpoints, places, torch.tensor([0.15, 0.15, 0.5])))
    shown = site_of_run(folder, Wanted(camera="0.jpg"))
    write_folder(replace(shown, page=replace(shown.page, metres_per_unit=metres)), root / "web")
    return root / "web"


@pytest.mark.system
@pytest.mark.parametrize("metres", [None, 10.0])
def test_a_known_distance_is_measured(browser: Browser, tmp_path: Path, metres: float | None) -> None:
    with (
        serving(measuring_run(tmp_path, metres)) as url,
        opened(browser, url, width=WIDTH, height=HEIGHT) as page,
    ):
        ready(page)
        page.click("#measure")
        focal = WIDTH / 2 / np.tan(np.radians(85 / 2))
        for x in (-1.0, 1.0):
            page.mouse.click(WIDTH / 2 + focal * x / 5, HEIGHT / 2)
            until(page, f"panolog.measure.points.length === {1 if x < 0 else 2}")
        assert page.evaluate("panolog.measure.length") == pytest.approx(2, rel=0.02)
        unit = "units" if metres is None else "m"
        assert unit in page.inner_text("#labels p").split()
        written = float(page.inner_text("#measured strong").split()[0])
        assert written == pytest.approx(2 * (metres or 1), rel=0.02)
        drawn = "document.querySelector('#lines line')?.getBoundingClientRect().width"  # anew in each frame
        until(page, f"Math.abs({drawn} / {2 * focal / 5} - 1) <= 0.03")
        page.mouse.click(WIDTH / 2, HEIGHT / 2 + 70)  # nothing is there
        expect(page.locator("#measured")).to_contain_text("nothing to measure")
        page.keyboard.press("Escape")
        expect(page.locator("#lines line")).to_have_count(0)


@pytest.mark.system
def test_a_damaged_model_or_a_browser_without_webgl_is_one_line(browser: Browser, tmp_path: Path) -> None:
    write_ply(tmp_path / "model.ply", some(30))
    write_folder(site_of_file(tmp_path / "model.ply", Wanted()), tmp_path / "web")
    (tmp_path / "web" / "model.sog").write_bytes(b"no model")
    bare = browser.browser_type.launch(executable_path=program(), args=["--no-sandbox", "--disable-3d-apis"])
    lines = {browser: "The model cannot be read", bare: "This browser cannot draw in 3D"}
    with closing(bare), serving(tmp_path / "web") as url:
        for one, line in lines.items():
            with opened(one, url, tolerate=lambda text: "WebGL" in text) as page:
                assert until(page, "document.documentElement.dataset.state") == "failed"
                expect(page.locator("#message")).to_contain_text(line)


@pytest.mark.system
def test_a_streamed_model_is_coarse_first_then_fine_and_bounded(browser: Browser, tmp_path: Path) -> None:
    folder = run_with(tmp_path)
    viewpoints = viewpoints_of(folder)
    model = cloud(viewpoints).select(torch.arange(3000) < 2000)
    write_ply(folder.model(COARSE), model)
    write_folder(site_of_run(folder, Wanted(streams=True, levels=2)), tmp_path / "web")
    levels = json.loads((tmp_path / "web" / "model" / "lod-meta.json").read_text())["counts"]
    assert len(levels) > 1
    with serving(tmp_path / "web") as url:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        seen: list[str] = []
        page.on("request", lambda request: seen.append(request.url.removeprefix(url)))
        page.goto(url)
        ready(page)
        first = [name.split("/")[1] for name in seen if name.endswith("/meta.json")]
        assert first
        assert first[0].startswith(f"{len(levels) - 1}_")  # all of the place in its coarsest level
        until(page, "panolog.stage.model.lodRangeMin === 0 && !panolog.stage.loading")
        picture = shown(page)
        drawn = page.evaluate("panolog.stage.app.stats.frame.gsplats")
        page.close()
    assert drawn <= 2000
    quality = psnr(picture, rendered(model, viewpoints, SIZE, background=picture[0, 0]))
    assert quality >= 25, f"{quality:.1f} dB"
