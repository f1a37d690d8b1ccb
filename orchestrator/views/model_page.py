"""A model in 3D as one HTML page that needs nothing else: viser's client with the Gaussians inside.

A page, not a server: it can be served by whoever may see the run, sent to somebody, or opened from the disk,
and nothing has to be kept running for it. Colours are those of degree 0, as viser shows them.
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
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import Trainee

MOST = 500_000  # Gaussians of a page: 10 to 20 MB, which a phone still turns smoothly
_TITLE = "<title>Viser</title>"
_FAR = 1e5  # where viser's camera sees nothing any more
_AHEAD = 0.2  # of the radius: what the camera turns about


@dataclass(frozen=True, eq=False)
class Stance:
    """From where a model is looked at, in world units."""

    position: NDArray[np.float64]  # (3,)
    ahead: NDArray[np.float64]  # (3,) unit
    up: NDArray[np.float64]  # (3,) unit


def write_run_page(
    folder: RunFolder, task: str | None, output: Path, *, most: int = MOST, locate: Locate = here
) -> Splats:
    """Writes the page of the current model of a run or of a task: `model_of`, then `write_page`.

    Args: locate says where the run's files are to be read.
    """
    model, title = locate(model_of(folder, task)), f"{task or 'model'} of {folder.root.absolute().name}"
    return write_page(model, output, title=title, most=most, stance=_stance(folder, task, locate))


def write_page(
    model: Path, output: Path, *, title: str, most: int = MOST, stance: Stance | None = None
) -> Splats:
    """Writes the page of a model: a PLY of Gaussians, or a checkpoint of this program.

    Args: output, written atomically; most Gaussians that it shows; stance to begin with, None for a look from
    above and outside.
    Returns what it shows. Raises InputError or RunError if the model cannot be read, or has no Gaussians;
    OSError if the page cannot be written.
    """
    splats = _splats(model, most)
    page = _page(splats, stance).replace(_TITLE, f"<title>{escape(title)}</title>", 1)
    write_bytes(output, page.encode())
    return splats


def _splats(model: Path, most: int) -> Splats:
    chunks: Chunks
    if _is_checkpoint(model):
        gaussians = Trainee.of(checkpoint.load(model).tensors).gaussians
        count, chunks = len(gaussians), partial(_whole, gaussians)
    else:
        count, chunks = ply_header(model)[0], partial(read_ply_chunks, model)
    if not count:
        raise InputError(f"{model}: has no Gaussians to show")
    return pick(chunks, count, most)


def _is_checkpoint(file: Path) -> bool:
    """Whether it begins as safetensors do: with the length of an object of JSON, then that."""
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return opened.read(9)[8:] == b"{"


def _whole(model: Gaussians) -> Iterator[Gaussians]:
    yield model


def _stance(folder: RunFolder, task: str | None, locate: Locate) -> Stance | None:
    """At the camera in the midst of those that train, towards the farthest; None before there is a plan.

    Up is across the plane that the cameras of the run keep to, and y points down, as usual.
    """
    if not folder.plan.is_file():
        return None
    plan = read_plan(locate(folder.plan))
    spread = np.ptp(plan.centers, axis=0)
    axis = 1 if spread[1] == spread.min() else int(spread.argmin())
    centers = plan.centers
    if task and task != "coarse" and (rows := plan.cameras(int(task.removeprefix("block/")))):
        centers = centers[np.isin(plan.rows, rows)]
    here = centers[np.linalg.norm(centers - np.median(centers, axis=0), axis=1).argmin()]
    away = centers - here
    away[:, axis] = 0
    ahead = away[np.linalg.norm(away, axis=1).argmax()]
    if not ahead.any():
        ahead = np.eye(3)[axis - 1]
    return Stance(here, ahead / np.linalg.norm(ahead), np.eye(3)[axis] * (-1 if axis == 1 else 1))


def _page(splats: Splats, stance: Stance | None) -> str:
    """The scene as viser writes it. Its server listens on this machine alone, until it has been written."""
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            _place_camera(server, splats, stance)
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


def _place_camera(server: viser.ViserServer, splats: Splats, stance: Stance | None) -> None:
    """Puts the camera there; from above and outside where there is no stance."""
    camera = server.initial_camera
    camera.far = _FAR
    if stance is None:
        server.scene.set_up_direction("-y")
        camera.position, camera.look_at = np.array([1.0, -0.8, 0.0]) * RADIUS, np.zeros(3)
        return
    server.scene.set_up_direction(stance.up)
    position = splats.place(stance.position)
    camera.position, camera.look_at = position, position + stance.ahead * _AHEAD * RADIUS
