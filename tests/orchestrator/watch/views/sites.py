"""Runs and pages in 3D for the tests in a browser."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import torch

from panolog.orchestrator.cli.commands.view import Site, SiteServer
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.views.site.viewpoints import Viewpoints, read_viewpoints
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import write_ply
from panolog.workers.tasks import COARSE
from tests.orchestrator.watch.views.models import make_run, save_plan, some
from tests.scenes import write_scene

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
        thread.join(10)


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
    folder = make_run(root / "a <run>", root / "scene")
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
