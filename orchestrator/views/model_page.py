"""A model in 3D as one self-contained HTML page: viser's client with the Gaussians inside.

A page, not a server: it can be served, sent, or opened from the disk, and no process has to keep running for
it. Colours are those of degree 0, as viser shows them.
"""

from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from html import escape
from io import StringIO
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from panolog.orchestrator.run.folder import RunFolder, model_of
from panolog.orchestrator.views.splats import RADIUS, Chunks, Splats, pick
from panolog.partition.plan import read_plan
from panolog.scene.errors import InputError
from panolog.scene.files import Locate, here, write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, read_ply_chunks
from panolog.workers.tasks import Stage, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import ModelState

MOST = 500_000  # Gaussians of a page: 10 to 20 MB, which a phone still turns smoothly
_TITLE = "<title>Viser</title>"
_FAR = 1e5  # far plane of viser's camera
_AHEAD = 0.2  # of the radius: diviewpoint of the point that the camera orbits


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The initial camera, in world units."""

    position: NDArray[np.float64]  # (3,)
    ahead: NDArray[np.float64]  # (3,) unit
    up: NDArray[np.float64]  # (3,) unit


def write_run_page(
    folder: RunFolder, task: TaskId | None, output: Path, *, most: int = MOST, locate: Locate = here
) -> Splats:
    """Writes the page of the current model of a run or of a task: `model_of`, then `write_page`.

    Args: locate says where the run's files are to be read.
    """
    model, title = locate(model_of(folder, task)), f"{task or 'model'} of {folder.root.absolute().name}"
    return write_page(model, output, title=title, most=most, viewpoint=_viewpoint(folder, task, locate))


def write_page(
    model: Path, output: Path, *, title: str, most: int = MOST, viewpoint: Viewpoint | None = None
) -> Splats:
    """Writes the page of a model: a PLY of Gaussians, or a checkpoint of this program.

    Args: output, written atomically; most Gaussians that it shows; viewpoint to begin with, None for one from
    above and outside.
    Returns what it shows. Raises InputError or RunError if the model cannot be read, or has no Gaussians;
    OSError if the page cannot be written.
    """
    splats = _splats(model, most)
    page = _page(splats, viewpoint).replace(_TITLE, f"<title>{escape(title)}</title>", 1)
    write_bytes(output, page.encode())
    return splats


def _splats(model: Path, most: int) -> Splats:
    chunks: Chunks
    if _is_checkpoint(model):
        gaussians = ModelState.from_tensors(checkpoint.load(model).tensors).gaussians
        count, chunks = len(gaussians), partial(_whole, gaussians)
    else:
        count, chunks = ply_header(model)[0], partial(read_ply_chunks, model)
    if not count:
        raise InputError(f"{model}: has no Gaussians to show")
    return pick(chunks, count, most)


def _is_checkpoint(file: Path) -> bool:
    """Whether a file starts like safetensors: with the length of a JSON object, then the object."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(9)[8:] == b"{"


def _whole(model: Gaussians) -> Iterator[Gaussians]:
    yield model


def _viewpoint(folder: RunFolder, task: TaskId | None, locate: Locate) -> Viewpoint | None:
    """At the most central camera that trains, towards the farthest; None before there is a plan.

    Up is perpendicular to the plane of the cameras, and y points down, as usual.
    """
    if not folder.plan.is_file():
        return None
    plan = read_plan(locate(folder.plan))
    spread = np.ptp(plan.centers, axis=0)
    axis = 1 if spread[1] == spread.min() else int(spread.argmin())
    centers = plan.centers
    if task and task.stage is Stage.BLOCK and (rows := plan.cameras(task.number)):
        centers = centers[np.isin(plan.rows, rows)]
    position = centers[np.linalg.norm(centers - np.median(centers, axis=0), axis=1).argmin()]
    away = centers - position
    away[:, axis] = 0
    ahead = away[np.linalg.norm(away, axis=1).argmax()]
    if not ahead.any():
        ahead = np.eye(3)[axis - 1]
    return Viewpoint(position, ahead / np.linalg.norm(ahead), np.eye(3)[axis] * (-1 if axis == 1 else 1))


def _page(splats: Splats, viewpoint: Viewpoint | None) -> str:
    """The scene as viser writes it. Its server listens on a loopback address, until that is done."""
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            _place_camera(server, splats, viewpoint)
            server.scene.add_gaussian_splats(
                "/model",
                centers=splats.centers,
                covariances=splats.covariances,
                rgbs=splats.colors,
                opacities=splats.opacities,
            )
            scene = server.get_scene_serializer()
        finally:
            server.stop()
    return scene.as_html(dark_mode=True)


def _place_camera(server: viser.ViserServer, splats: Splats, viewpoint: Viewpoint | None) -> None:
    """Places the camera: at the viewpoint, or above and outside the model."""
    camera = server.initial_camera
    camera.far = _FAR
    if viewpoint is None:
        server.scene.set_up_direction("-y")
        camera.position, camera.look_at = np.array([1.0, -0.8, 0.0]) * RADIUS, np.zeros(3)
        return
    server.scene.set_up_direction(viewpoint.up)
    position = splats.place(viewpoint.position)
    camera.position, camera.look_at = position, position + viewpoint.ahead * _AHEAD * RADIUS
