"""Models in 3D: which Gaussians a page shows, from where, and that it is one whole page of its own."""

import asyncio
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from panolog.orchestrator.cli import app
from panolog.orchestrator.dashboard.discovery import RunEntry
from panolog.orchestrator.dashboard.model_pages import ModelPages
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.folder import RunFolder, model_of, write_json
from panolog.orchestrator.run.info import SceneRef, make_info, write_info
from panolog.orchestrator.views.model_page import write_page, write_run_page
from panolog.orchestrator.views.splats import RADIUS, Splats, pick
from panolog.orchestrator.views.viewpoints import read_viewpoints
from panolog.partition.cells import Grid
from panolog.partition.plan import PartitionConfig, make_plan
from panolog.scene.errors import InputError, RunError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply, write_ply_parts
from panolog.scene.read import read_scene
from panolog.workers.events import Checkpoint
from panolog.workers.tasks import COARSE, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import ModelState
from tests.scenes import write_scene


def some(count: int, sky: int = 0, seed: int = 0) -> Gaussians:
    """Random Gaussians about (10, 20, 30); the sky ones far away and large."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    far = torch.arange(count) >= count - sky
    offsets = torch.nn.functional.normalize(normal(count, 3), dim=1) * torch.where(far, 500.0, 2.0)[:, None]
    return Gaussians(
        means=offsets + torch.tensor([10.0, 20.0, 30.0]),
        quats=normal(count, 4),
        scales=normal(count, 3) * 0.2 + torch.where(far, 1.0, -4.0)[:, None],
        opacities=normal(count),
        sh0=normal(count, 1, 3),
        shN=torch.zeros(count, 15, 3),
        sky=sky,
    )


def picked(model: Gaussians, most: int, pieces: int = 3) -> Splats:
    def chunks() -> Iterator[Gaussians]:
        for part in torch.arange(len(model)).chunk(pieces):
            yield model.select(torch.isin(torch.arange(len(model)), part))

    return pick(chunks, len(model), most)


def test_all_gaussians_of_a_small_model_are_shown_as_they_are() -> None:
    model = some(50)
    splats = picked(model, 50)
    assert np.allclose(splats.place(model.means.numpy()), splats.centers, atol=1e-5)
    assert np.isclose(np.median(np.linalg.norm(splats.centers, axis=1)), RADIUS, rtol=0.05)
    values = np.linalg.eigvalsh(splats.covariances)
    expected = np.sort(model.scales.exp().numpy() * splats.scale, axis=1) ** 2
    assert np.allclose(values, expected, rtol=1e-3)
    assert np.allclose(splats.opacities[:, 0], model.opacities.sigmoid().numpy())
    assert splats.colors.min() >= 0
    assert splats.colors.max() <= 1


def test_covariances_point_where_the_quaternions_do() -> None:
    turn = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]])  # x becomes y, and the length does not matter
    model = replace(some(1), quats=3 * turn, scales=torch.tensor([[2.0, 0.0, 0.0]]))
    splats = picked(model, 1, pieces=1)
    assert np.allclose(splats.covariances[0] / splats.scale**2, np.diag([1, np.exp(4), 1]), atol=1e-4)


def test_of_a_large_model_those_remain_that_cover_most() -> None:
    model = some(300, sky=100)
    hidden = torch.arange(300) % 3 == 0
    model = replace(model, opacities=torch.where(hidden, -9.0, 3.0))
    splats = picked(model, 150, pieces=7)
    assert len(splats) == 150
    assert splats.opacities.min() > 0.9
    sky = np.linalg.norm(splats.centers, axis=1) > 10 * RADIUS
    assert 0 < sky.sum() < 150
    assert (splats.centers == picked(model, 150, pieces=1).centers).all()


def test_a_model_in_one_point_or_of_sky_alone_can_be_shown() -> None:
    point = some(5)
    point = replace(point, means=point.means[:1].expand(5, 3).clone())
    for model in (point, some(5, sky=5), some(1)):
        splats = picked(model, 4, pieces=1)
        assert all(np.isfinite(values).all() for values in (splats.centers, splats.covariances))


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run that trains one block and has done the other."""
    folder = RunFolder(tmp_path / "a <run>")
    folder.root.mkdir()
    write_info(folder, make_info(SceneRef(path="/gone", fingerprint="f"), RunConfig(width=64)))
    return folder


def save_model(folder: RunFolder, task: TaskId, count: int = 20, sky: int = 0) -> None:
    folder.of(task).mkdir(parents=True, exist_ok=True)
    write_ply(folder.model(task), some(count, sky))


def save_checkpoint(folder: RunFolder, task: TaskId, count: int = 20) -> None:
    folder.of(task).mkdir(parents=True, exist_ok=True)
    checkpoint.save(folder.checkpoint(task), Checkpoint(task, 5, ModelState.start(some(count, 2)).tensors()))


def save_plan(folder: RunFolder) -> None:
    centers = np.array([[x, 5.0, x % 2] for x in range(6)])
    plan = make_plan(
        centers,
        some(20).means.numpy(),
        np.zeros((6, 2)),
        Grid.parse("2x1x1"),
        PartitionConfig(),
        rows=range(6),
        names=[f"{i}.jpg" for i in range(6)],
    )
    write_json(folder.plan, plan.to_json())


def test_a_page_begins_at_the_panorama_that_is_named(folder: RunFolder) -> None:
    with pytest.raises(InputError, match="has no plan yet"):
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


def test_a_panorama_that_is_held_out_comes_from_the_scene(folder: RunFolder, tmp_path: Path) -> None:
    save_plan(folder)
    with pytest.raises(InputError, match=r"^camera 1\.png: is not in the run's plan, and its scene: /gone"):
        read_viewpoints(folder, None, "1.png")
    write_scene(tmp_path / "scene")
    write_info(
        folder, make_info(SceneRef(path=str(tmp_path / "scene"), fingerprint="f"), RunConfig(width=64))
    )
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
    write_ply(folder.point_cloud, some(3))
    assert model_of(folder) == folder.point_cloud


@pytest.mark.parametrize("task", ["", "score", "../x", "block/../../x", "block/000\n", "coarse/.."])
def test_a_task_is_no_path(task: str) -> None:
    with pytest.raises(InputError, match="is not a task"):
        TaskId.parse(task)


def test_a_task_without_a_model(folder: RunFolder) -> None:
    with pytest.raises(InputError, match="score/000 is not a task that trains"):
        model_of(folder, TaskId.shard(0))


def test_a_page_is_self_contained(folder: RunFolder, tmp_path: Path) -> None:
    save_checkpoint(folder, TaskId.block(0))
    save_plan(folder)
    page = tmp_path / "page.html"
    assert len(write_run_page(folder, TaskId.block(0), page, most=7)) == 7
    html = page.read_text()
    assert "<title>block/000 of a &lt;run&gt;</title>" in html
    assert "__VISER_EMBED_DATA__" in html
    assert 'src="http' not in html


@pytest.mark.parametrize("content", [b"", b"ply\nformat ascii 1.0\n", b"\x10" + bytes(7) + b"{" + bytes(20)])
def test_what_is_no_model(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model"
    path.write_bytes(content)
    with pytest.raises((InputError, RunError)):
        write_page(path, tmp_path / "page.html", title="")
    assert not (tmp_path / "page.html").exists()


def test_a_model_without_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    write_ply_parts(path, [], count=0, sky=0)
    with pytest.raises(InputError, match="has no Gaussians to show"):
        write_page(path, tmp_path / "page.html", title="")


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


def view(*arguments: object) -> Result:
    return CliRunner().invoke(app.app, ["view", *map(str, arguments)])


def test_the_command_prints_the_address_and_opens_it(folder: RunFolder, browsed: list[str]) -> None:
    save_model(folder, COARSE)
    page = folder.root / "out.html"
    for option in ("--max-gaussians", "--most"):
        done = view(folder.root, option, 5, "-o", page)
        assert (done.exit_code, done.stdout, browsed) == (0, f"{page.as_uri()}\n", [])
        assert done.stderr.endswith("5 of 20 Gaussians\n")
    assert page.is_file()
    done = view(folder.model(COARSE))
    assert done.stdout == f"{browsed[0]}\n"
    assert done.stderr.endswith("20 Gaussians\n")
    assert browsed[0].startswith("file:///")


def test_the_command_without_a_browser(
    folder: RunFolder, browsed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_model(folder, COARSE)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    done = view(folder.root)
    assert (done.exit_code, browsed) == (0, [])
    assert "there is no browser here: copy the page" in done.stderr


def test_wrong_arguments_of_the_command(folder: RunFolder, browsed: list[str], tmp_path: Path) -> None:
    save_model(folder, COARSE)
    for wrong in (
        ["/none"],
        [tmp_path],
        [folder.root, "--task", TaskId.block(9)],
        [folder.model(COARSE), "--task", COARSE],
        [folder.model(COARSE), "--camera", "0.jpg"],
        [folder.root, "--camera", "0.jpg"],
        [folder.root, "-o", "/none/page.html"],
    ):
        done = view(*wrong)
        assert (done.exit_code, done.stdout, browsed) == (2, "", [])


@pytest.mark.system
def test_pages_for_the_dashboard_are_made_once_and_kept_for_a_while(folder: RunFolder) -> None:
    save_model(folder, COARSE)
    place = RunEntry(folder.root.parent.resolve(), folder.root.name)

    async def check() -> None:
        pages = ModelPages()
        try:
            first, again = await asyncio.gather(pages.make(place, None), pages.make(place, None))
            assert first == again
            path = pages.page(first)
            made = path.stat().st_mtime_ns
            assert await pages.make(place, None) == first
            assert path.stat().st_mtime_ns == made
            for key in ("", "../x", first[:-1]):
                with pytest.raises(InputError, match="was removed"):
                    pages.page(key)
            folder.model(COARSE).write_bytes(b"nonsense")
            with pytest.raises(InputError, match=r"model\.ply: not a PLY file") as caught:
                await pages.make(place, None)
            assert "/proc" not in str(caught.value)
        finally:
            pages.close()
        assert not path.exists()

    asyncio.run(check())


def test_a_page_shows_nothing_from_outside_the_run(folder: RunFolder, tmp_path: Path) -> None:
    secret = tmp_path / "secret.ply"
    write_ply(secret, some(3))
    folder.point_cloud.symlink_to(secret)
    place = RunEntry(folder.root.parent.resolve(), folder.root.name)

    async def check() -> None:
        pages = ModelPages()
        try:
            with pytest.raises(InputError, match="not a plain file of the run"):
                await pages.make(place, None)
        finally:
            pages.close()

    asyncio.run(check())
    assert json.loads(folder.info.read_text())
