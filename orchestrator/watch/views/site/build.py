"""The page of a model of a run, of a task or of a file: from where it is looked at, and its photographs."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from panolog.export.detail import SIDE
from panolog.export.frame import Frame
from panolog.export.georeference import Georeference, georeference_from
from panolog.export.reduce import Reduced, extent
from panolog.export.site.page import (
    MOST_CAMERAS,
    PHOTOGRAPHS,
    Page,
    PageCamera,
    Pose,
    photograph_rotation,
    photograph_url,
)
from panolog.export.site.write import MOST_IN_ONE, SKY, write_page, write_site
from panolog.export.sky import WIDTH, render_sky, write_sky_image
from panolog.export.sog.read import count_of
from panolog.export.sog.streamed import write_streamed
from panolog.export.sog.whole_folder import INDEX
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory, Selection, Splats
from panolog.orchestrator.runs.folder import RunFolder, read_head, shown_model
from panolog.orchestrator.watch.views.site.photographs import panorama_rotations, photograph
from panolog.orchestrator.watch.views.site.source import Model, open_model
from panolog.orchestrator.watch.views.site.viewpoints import Viewpoint, Viewpoints, read_viewpoints
from panolog.scene.errors import InputError
from panolog.scene.files import Locate, here, write_bytes
from panolog.scene.stores.stored_scenes import local_folder
from panolog.scene.write import StageProgress, no_progress
from panolog.workers.tasks import TaskId

STREAMED_FROM = MOST_IN_ONE  # Gaussians up to which a model is one file
MODEL, STREAMED = "model.sog", "model"
_SOG = ".sog"
_STEPS = 10  # of the radius: how far one sees around from outside


@dataclass(frozen=True)
class Wanted:
    """What is to be shown of a run: None for the usual."""

    task: TaskId | None = None
    camera: str | None = None  # the panorama to begin at
    most: int | None = None  # Gaussians; None = all, and of a page that is one file `MOST_IN_ONE`
    selection: Selection = field(default_factory=Selection)  # of the scene; its part is not considered
    sky: bool = True
    streams: bool = False  # also a model that would be one file
    levels: int | None = None  # of detail of a model that streams; None = as many as it takes
    place: Georeference | None = None  # None = what is known of it


@dataclass(frozen=True, eq=False)
class Shown:
    """A page to be written, and what it is made of."""

    page: Page
    write_model: Callable[[Path], str]  # `write_site`'s
    scene: Path | None  # the folder of the photographs, if it is on this machine


def site_of_run(folder: RunFolder, wanted: Wanted, locate: Locate = here) -> Shown:
    """The page of the current model of a run or of a task (`shown_model`).

    Args: locate says where the run's files are to be read.
    Raises InputError or RunError if the run or its model cannot be read, or there is no such camera.
    """
    path = locate(shown_model(folder, wanted.task))
    viewpoints = read_viewpoints(folder, wanted.task, wanted.camera, locate)
    place = wanted.place or place_of(folder, viewpoints, locate)
    model = open_model(path, place.upside_down, wanted.selection)
    page = _page(f"{wanted.task or 'model'} of {folder.place.name}", model, place, wanted)
    scene = None
    if viewpoints is not None:
        cameras, scene = _cameras(viewpoints, place.frame, local_folder(read_head(folder)[0]))
        start = _pose(viewpoints.start, place.frame)
        page = replace(page, cameras=cameras, start=start, step=_spacing(cameras) or page.step)
    return Shown(*_reduced(page, model, place, wanted), scene)


def site_of_file(path: Path, wanted: Wanted) -> Shown:
    """The page of a model in a file: a PLY of Gaussians, a checkpoint of this program, or a .sog as it is.

    Raises InputError if it cannot be read or has no Gaussians.
    """
    if path.suffix.lower() == _SOG and (count := count_of(path)) <= (wanted.most or count):
        return Shown(Page(path.stem), lambda folder: _copied(path, folder), None)
    place = wanted.place or Georeference()
    model = open_model(path, place.upside_down, wanted.selection)
    return Shown(*_reduced(_page(path.name, model, place, wanted), model, place, wanted), None)


def write_folder(shown: Shown, folder: Path, progress: StageProgress = no_progress) -> None:
    """Writes the page as a folder for any web server, with the photographs. Raises as `write_site`."""
    page, scene = shown.page, shown.scene
    if scene is None:
        write_site(folder, shown.write_model, page)
        return
    source, page = scene, with_photographs(page)

    def write(new: Path) -> str:
        (new / PHOTOGRAPHS).mkdir()
        for number, camera in enumerate(page.cameras):
            if camera.photograph is not None:
                write_bytes(new / camera.photograph, photograph(source, camera.name))
            progress("photographs", number + 1, len(page.cameras))
        progress("writing the model", 0, 0)
        return shown.write_model(new)

    write_site(folder, write, page)


def write_file(shown: Shown, path: Path) -> None:
    """Writes the page as one file, without photographs. Raises OSError."""
    with TemporaryDirectory(prefix="panolog-view-") as folder:
        model = Path(folder) / shown.write_model(Path(folder))
        write_page(path, model.read_bytes(), shown.page)


def with_photographs(page: Page) -> Page:
    """The page with the URLs under which its photographs are served or written."""
    return page.with_photographs([photograph_url(number) for number in range(len(page.cameras))])


def _page(title: str, model: Model, place: Georeference, wanted: Wanted) -> Page:
    """What a page says of a model, seen from outside."""
    (x, y, z), radius = extent(model.scene)
    middle = np.array([-x, -y, z])  # as the page turns the file
    away = np.array([0.8, 0.5, 0.8]) * radius
    return Page(
        title=title,
        total=model.total,
        iteration=model.iteration,
        start=Pose.towards(middle + away, -away),
        step=radius / _STEPS,
        metres_per_unit=place.unit,
        frame=place.frame,
        sky=_sky_picture(model, place.frame) if wanted.sky else None,
    )


def _sky_picture(model: Model, frame: Frame) -> bytes | None:
    """JPEG, of a model in training a small one, which is soon another; None without a sky."""
    if model.sky is None:
        return None
    width = WIDTH if model.iteration is None else WIDTH // 2
    with TemporaryDirectory(prefix="panolog-view-") as folder:
        path = Path(folder) / SKY
        write_sky_image(path, render_sky(model.sky, frame, width))
        return path.read_bytes()


def _reduced(
    page: Page, model: Model, place: Georeference, wanted: Wanted
) -> tuple[Page, Callable[[Path], str]]:
    """The page and the writer of a model of which at most so many Gaussians are shown."""
    source = model.scene if wanted.most is None else Reduced(model.scene, wanted.most)
    left = model.scene.count - source.count

    def write(folder: Path) -> str:
        if source.count <= STREAMED_FROM and not wanted.streams:
            write_sog(folder / MODEL, source)
            return MODEL
        seen = model.sky if wanted.sky else None
        sky = None if seen is None else InMemory(Splats.of(seen).turned(place.upside_down))
        side = SIDE / (place.unit or 1.0)
        write_streamed(folder / STREAMED, source, sky, side=side, levels=wanted.levels)
        _write_indices(folder)
        return f"{STREAMED}/{INDEX}"

    return replace(page, shown=model.total - model.missing - left), write


def _write_indices(folder: Path) -> None:
    """The index of a model with its sky goes to the page's folder, for other viewers.

    This page has the sky as a picture, so its own index leaves it out.
    """
    index = folder / STREAMED / INDEX
    whole = json.loads(index.read_bytes())
    moved = [f"{STREAMED}/{name}" for name in whole["filenames"]]
    if environment := whole.pop("environment", None):
        write_bytes(index, json.dumps(whole, separators=(",", ":")).encode())
        whole["environment"] = f"{STREAMED}/{environment}"
    write_bytes(folder / INDEX, json.dumps(whole | {"filenames": moved}, separators=(",", ":")).encode())


def _copied(path: Path, folder: Path) -> str:
    shutil.copyfile(path, folder / MODEL)
    return MODEL


def written_place(folder: RunFolder, locate: Locate = here) -> Georeference | None:
    """What georef.json says of a run's place; None if there is none. Args: locate as `place_of`.

    Raises InputError if it is damaged.
    """
    file = folder.georeference
    if not file.is_file():
        return None
    try:
        return georeference_from(json.loads(locate(file).read_bytes()), file)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: is not JSON: {error}; remove it") from error


def place_of(folder: RunFolder, viewpoints: Viewpoints | None, locate: Locate = here) -> Georeference:
    """What the run has written of its place, or what its cameras say.

    Args: locate says where the run's files are to be read.
    Raises InputError if what it has written is damaged.
    """
    if (known := written_place(folder, locate)) is not None:
        return known
    if viewpoints is None:
        return Georeference()
    up, middle = viewpoints.up.tolist(), np.round(viewpoints.positions.mean(axis=0)).tolist()
    return Georeference(tuple(up), tuple(middle))


def _pose(viewpoint: Viewpoint, frame: Frame) -> Pose:
    return Pose.towards(frame.points(viewpoint.position), frame.rotation @ viewpoint.ahead)


def _cameras(viewpoints: Viewpoints, frame: Frame, scene: Path) -> tuple[tuple[PageCamera, ...], Path | None]:
    """The cameras of a page, and the folder of their photographs if that is on this machine."""
    named = dict(list(viewpoints.cameras.items())[:MOST_CAMERAS])
    try:
        rotations = panorama_rotations(scene, list(named))
    except InputError:
        rotations = {}  # a run can be looked at without its scene
    cameras = tuple(
        PageCamera(
            name,
            _pose(viewpoint, frame),
            photograph_rotation(frame, rotations[name]) if name in rotations else None,
        )
        for name, viewpoint in named.items()
    )
    return cameras, scene if rotations else None


def _spacing(cameras: Sequence[PageCamera]) -> float | None:
    """The usual distance between one camera and the next; None if there is none."""
    places = np.array([camera.pose.position for camera in cameras])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else None
