"""A model in 3D as one self-contained HTML page: viser's client with the Gaussians inside.

A page, not a server: it can be served, sent, or opened from the disk, and no process has to keep running for
it. Colours are those of degree 0, as viser shows them.
"""

from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import partial
from html import escape
from io import StringIO
from pathlib import Path

import numpy as np
import viser

from panolog.orchestrator.run.folder import RunFolder, model_of
from panolog.orchestrator.views.splats import RADIUS, Chunks, Splats, pick
from panolog.orchestrator.views.viewpoints import Viewpoints, read_viewpoints
from panolog.scene.errors import InputError
from panolog.scene.files import Locate, here, write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, read_ply_chunks
from panolog.workers.tasks import TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import ModelState

MOST = 500_000  # Gaussians of a page: 10 to 20 MB, which a phone still turns smoothly
_TITLE = "<title>Viser</title>"
_FAR = 1e5  # far plane of viser's camera
_AHEAD = 0.2  # of the radius: distance of the point that the camera orbits


def write_run_page(
    folder: RunFolder,
    task: TaskId | None,
    output: Path,
    *,
    camera: str | None = None,
    most: int = MOST,
    locate: Locate = here,
) -> Splats:
    """Writes the page of the current model of a run or of a task: `model_of`, then `write_page`.

    Args: camera, the name of the panorama to begin at (`read_viewpoints`); locate says where the run's files
    are to be read.
    """
    model, title = locate(model_of(folder, task)), f"{task or 'model'} of {folder.root.absolute().name}"
    viewpoints = read_viewpoints(folder, task, camera, locate)
    return write_page(model, output, title=title, most=most, viewpoints=viewpoints)


def write_page(
    model: Path, output: Path, *, title: str, most: int = MOST, viewpoints: Viewpoints | None = None
) -> Splats:
    """Writes the page of a model: a PLY of Gaussians, or a checkpoint of this program.

    Args: output, written atomically; most Gaussians that it shows; viewpoints to begin
    with and to choose from, None for one from above and outside.
    Returns what it shows. Raises InputError or RunError if the model cannot be read, or has no Gaussians;
    OSError if the page cannot be written.
    """
    splats = _splats(model, most)
    page = _page(splats, viewpoints).replace(_TITLE, f"<title>{escape(title)}</title>", 1)
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


def _page(splats: Splats, viewpoints: Viewpoints | None) -> str:
    """The scene as viser writes it. Its server listens on a loopback address, until that is done."""
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            _place_camera(server, splats, viewpoints)
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


def _place_camera(server: viser.ViserServer, splats: Splats, viewpoints: Viewpoints | None) -> None:
    """Places the camera: where the viewpoints begin, or above and outside the model."""
    camera = server.initial_camera
    camera.far = _FAR
    if viewpoints is None:
        server.scene.set_up_direction("-y")
        camera.position, camera.look_at = np.array([1.0, -0.8, 0.0]) * RADIUS, np.zeros(3)
        return
    server.scene.set_up_direction(viewpoints.up)
    camera.position = splats.place(viewpoints.start.position)
    camera.look_at = camera.position + viewpoints.start.ahead * _AHEAD * RADIUS
