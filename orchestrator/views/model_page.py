"""A model in 3D as one self-contained HTML page: viser's client with the Gaussians inside.

A page, not a server: it can be served, sent, or opened from the disk, and no process has to keep running for
it. Colours are those of degree 0, as viser shows them.
"""

import json
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import partial
from html import escape
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from panolog.orchestrator.run.folder import RunFolder, model_of
from panolog.orchestrator.views.splats import RADIUS, Chunks, Splats, pick
from panolog.orchestrator.views.viewpoints import Viewpoint, Viewpoints, read_viewpoints
from panolog.scene.errors import InputError
from panolog.scene.files import Locate, here, write_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_header, read_ply_chunks
from panolog.workers.tasks import TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.optimizer import ModelState

MOST = 500_000  # Gaussians of a page: 10 to 20 MB, which a phone still turns smoothly
_CAMERAS = 20_000  # that a page has to choose from: 2 MB
_FILES = Path(__file__).with_name("viewer")
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

    Args: output, written atomically; most Gaussians that it shows; viewpoints to begin with
    and to choose from, None for one from above and outside.
    Returns what it shows. Raises InputError or RunError if the model cannot be read, or has no Gaussians;
    OSError if the page cannot be written.
    """
    splats = _splats(model, most)
    write_bytes(output, _page(splats, title, viewpoints).encode())
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


def _page(splats: Splats, title: str, viewpoints: Viewpoints | None) -> str:
    """viser's page of the scene, with a panel in front of it and a script before all of its own."""
    nodes = _nodes(splats)
    content = {
        "title": title,
        "shown": len(splats),
        "total": splats.total,
        "sky": splats.sky,
        "nodes": list(nodes),
        "cameras": _cameras(splats, viewpoints),
    }
    data = json.dumps(content).replace("<", "\\u003c")
    panel = f'{_file("overlay.html")}<script type="application/json" id="panolog-page">{data}</script>'
    page = _scene(splats, nodes, viewpoints)
    for place, text in (
        ("<head>", f"<head><script>{_file('workers.js')}</script>"),
        ("<title>Viser</title>", f"<title>{escape(title)}</title>"),
        ("</head>", f"<style>{_file('overlay.css')}</style></head>"),
        ("<body>", f'<body>{panel}<script type="module">{_file("overlay.js")}</script>'),
    ):
        before, found, after = page.partition(place)
        assert found, f"viser's page has no {place}"
        page = before + text + after
    return page


def _file(name: str) -> str:
    return (_FILES / name).read_text()


def _nodes(splats: Splats) -> dict[str, slice]:
    """The nodes of the scene, and which Gaussians each has."""
    sky = len(splats) - splats.sky
    parts = {"/model": slice(0, sky), "/sky": slice(sky, len(splats))}
    return {name: part for name, part in parts.items() if part.start < part.stop}


def _cameras(splats: Splats, viewpoints: Viewpoints | None) -> list[dict[str, Any]]:
    """The cameras to choose from, in the coordinates of the page."""
    cameras = list(viewpoints.cameras.items())[:_CAMERAS] if viewpoints else []
    return [
        {"name": name, **{key: point.round(4).tolist() for key, point in _pose(splats, camera).items()}}
        for name, camera in cameras
    ]


def _pose(splats: Splats, viewpoint: Viewpoint) -> dict[str, NDArray[np.floating]]:
    """Where a viewpoint is and what it looks at, in the coordinates of the page."""
    position = splats.place(viewpoint.position)
    return {"position": position, "look_at": position + viewpoint.ahead * _AHEAD * RADIUS}


def _scene(splats: Splats, nodes: dict[str, slice], viewpoints: Viewpoints | None) -> str:
    """The page as viser writes it. Its server listens on a loopback address, until that is done."""
    with redirect_stdout(StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            _place_camera(server, splats, viewpoints)
            for name, part in nodes.items():
                server.scene.add_gaussian_splats(
                    name,
                    centers=splats.centers[part],
                    covariances=splats.covariances[part],
                    rgbs=splats.colors[part],
                    opacities=splats.opacities[part],
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
    start = _pose(splats, viewpoints.start)
    camera.position, camera.look_at = start["position"], start["look_at"]
