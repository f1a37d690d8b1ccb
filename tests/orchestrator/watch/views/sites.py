"""Runs and pages in 3D for the tests in a browser, what these show, and our own render of the same view."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from playwright.sync_api import Page

from panolog.orchestrator.cli.commands.view import Site, SiteServer
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_file
from panolog.orchestrator.watch.views.site.viewpoints import Viewpoints, read_viewpoints
from panolog.renderer.camera import Camera, Lens, perspective
from panolog.renderer.render import render, to_bytes
from panolog.scene.gaussians import Gaussians, logit
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.history import begun
from tests.orchestrator.watch.views.models import save_plan, some
from tests.scenes import write_scene
from tests.visual.compare import expand

SIZE = (480, 320)
COUNT = 12
NAMES = [f"street/{i:03d}.png" for i in range(COUNT - 1)] + ["<b>&evil.png"]
CENTERS = np.array([[i, 5.0, 0.3 * (i % 2)] for i in range(COUNT)])


@contextmanager
def serving(page: Path | Site) -> Iterator[str]:
    """The address of a page, or of its folder."""
    server = SiteServer(page if isinstance(page, Site) else Site(page))
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.url
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def viewpoints_of(folder: RunFolder, camera: str | None = None) -> Viewpoints:
    found = read_viewpoints(folder, None, camera)
    assert found is not None
    return found


def run_with(root: Path, model: Gaussians | None = None, names: list[str] = NAMES) -> RunFolder:
    """A run with a plan and a scene, whose photographs are each of one colour of their own."""
    write_scene(root / "scene", names=names)
    for number, name in enumerate(names):
        colour = np.full((512, 1024, 3), (20 * number, 255 - 20 * number, 128), np.uint8)
        (root / "scene" / "images" / name).write_bytes(bytes(cv2.imencode(".png", colour)[1]))
    folder = begun(root / "a <run>", scene=root / "scene")
    save_plan(folder, names, CENTERS[: len(names)])
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), model or cloud(viewpoints_of(folder)))
    return folder


def cloud(viewpoints: Viewpoints, larger: tuple[float, float] = (2.0, 3.0)) -> Gaussians:
    """Gaussians of all shapes and opacities around a point ahead, and a sky of large ones.

    Args: larger, how much those near and those of the sky are larger than `some`, as logarithms.
    """
    model = some(3000, sky=1000, seed=3)
    far = (torch.arange(3000) >= 2000)[:, None]
    ahead = viewpoints.start.position + 6 * viewpoints.start.ahead
    return replace(
        model,
        means=model.means
        - torch.tensor([10.0, 20, 30])
        + torch.where(far, 0, torch.from_numpy(ahead)).float(),
        scales=model.scales + torch.where(far, larger[1], larger[0]),
        opacities=model.opacities + 1.5,
    )


FOV = 85.0  # degrees along the longer side of the window: of static/stage.js
_WAIT_S = 60.0
_BARE = "for (const id of ['panel', 'walk', 'state']) document.getElementById(id).style.visibility = 'hidden'"


def until(page: Page, expression: str) -> Any:
    """Waits until an expression is true: the page's policy forbids the wait that Playwright has for that."""
    end = time.monotonic() + _WAIT_S
    while not (found := page.evaluate(expression)):
        assert time.monotonic() < end, f"never: {expression}"
        page.wait_for_timeout(50)
    return found


def ready(page: Page) -> None:
    """Waits for the first picture of a model."""
    assert until(page, "document.documentElement.dataset.state") == "ready"


def shown(page: Page) -> NDArray[np.uint8]:
    """(H, W, 3) BGR: what the page draws once it is at rest, without the panels over it."""
    ready(page)
    page.evaluate(_BARE)
    pictures = [expand(page.screenshot())]
    while len(pictures) < 3 or not all(np.array_equal(picture, pictures[-1]) for picture in pictures[-3:]):
        page.wait_for_timeout(150)
        pictures.append(expand(page.screenshot()))
    return pictures[-1]


def rendered(
    model: Gaussians, viewpoints: Viewpoints, size: tuple[int, int], background: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """(H, W, 3) BGR of a model from where the viewpoints start, over a background (3,); size is (W, H)."""
    width, height = size
    view, down = viewpoints.start, -viewpoints.up
    fov = (
        FOV
        if width > height
        else 2 * math.degrees(math.atan(math.tan(math.radians(FOV) / 2) * width / height))
    )
    lens = Lens(width, height, fov)
    rotation = np.stack([np.cross(down, view.ahead), down, view.ahead])
    W = lens.panorama_width
    drawn = render(model, Camera.of(rotation, -rotation @ view.position, W, W // 2))
    behind = (1 - drawn.alpha)[..., None] * torch.from_numpy(background[::-1] / np.float32(255))
    return np.ascontiguousarray(perspective(to_bytes(drawn.color + behind), lens)[..., ::-1])


def layers(viewpoints: Viewpoints, count: int = 60) -> Gaussians:
    """Opaque balls in front of where the viewpoints start, nearest first: not the order to draw."""
    random = torch.Generator().manual_seed(1)
    depth = torch.linspace(2, 12, count)[:, None]
    across = (torch.rand(count, 2, generator=random) - 0.5) * depth * 0.9
    return balls(viewpoints, torch.cat([across, depth], 1), depth[:, 0] * 0.1)


def page_of_layers(root: Path, opacities: torch.Tensor | None = None) -> tuple[Path, Gaussians, Viewpoints]:
    """The page of `layers` as one file, with their model and the viewpoints, which begin at 1.jpg.

    Args: opacities (60,) of the layers, logits, if they are not to be opaque.
    """
    folder = begun(root / "run")
    save_plan(folder)
    viewpoints = viewpoints_of(folder, "1.jpg")
    model = layers(viewpoints)
    if opacities is not None:
        model = replace(model, opacities=opacities)
    folder.of(COARSE).mkdir()
    write_ply(folder.model(COARSE), model)
    write_file(site_of_run(folder, Wanted(camera="1.jpg")), root / "page.html")
    return root / "page.html", model, viewpoints


def balls(viewpoints: Viewpoints, places: torch.Tensor, radii: torch.Tensor) -> Gaussians:
    """Opaque balls at places (N, 3): to the right, down and ahead of where the viewpoints start."""
    random = torch.Generator().manual_seed(2)
    down, ahead = -viewpoints.up, viewpoints.start.ahead
    axes = torch.from_numpy(np.stack([np.cross(down, ahead), down, ahead])).float()
    count = len(places)
    return Gaussians(
        means=places @ axes + torch.from_numpy(viewpoints.start.position).float(),
        quats=torch.eye(4)[:1].repeat(count, 1),
        scales=radii.log()[:, None].repeat(1, 3),
        opacities=torch.full((count,), logit(0.99)),
        sh0=(torch.rand(count, 1, 3, generator=random) - 0.5) * 3.5,
        shN=torch.zeros(count, 15, 3),
        sky=0,
    )


def psnr(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """Peak signal-to-noise ratio in dB of two pictures of the same shape."""
    return float(cv2.PSNR(first, second))
