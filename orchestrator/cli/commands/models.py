"""Models that commands take: PLYs as they are, and exported ones turned back into a run's world."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from panolog.export.frame import Frame
from panolog.export.georeference import georeference_of
from panolog.export.reading import convert_to_ply, is_ply, is_spz, sky_of
from panolog.orchestrator.cli.console import say
from panolog.orchestrator.runs.folder import RunFolder
from panolog.scene.model import Scene
from panolog.scene.ply import describe_faults, ply_exported

Axes = Literal["export", "model"]


def frame_in(path: Path, scene: Scene, axes: Axes) -> Frame:
    """The frame of a file: that of the exports of a scene's runs in its format, or that of their models."""
    if axes == "model":
        return Frame()
    place = georeference_of(scene)
    return place.frame if is_spz(path) else place.upside_down


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def say_missing_sky(path: Path) -> None:
    """Says of an SPZ without a sky where that would be: it may have been left behind."""
    if is_spz(path) and not path.stem.endswith("-sky") and not sky_of(path).is_file():
        say(f"{path}: has no sky; if it was exported with one, that is {sky_of(path).name}, to be next to it")


def say_unmerged(run: RunFolder, model: Path) -> None:
    """Says so if a model is shown in place of the merged one, which is to come or was removed."""
    if model != run.point_cloud:
        say(f"{run.place.name}: has no merged model; this is its model of Stage I")


@contextmanager
def as_ply(path: Path, frame: Callable[[], Frame], *, exact: bool) -> Iterator[Path]:
    """Yields a model as a PLY: its own path, or that of a temporary file.

    Args: frame, returns that which an exported one is turned back from; exact, `Gaussians.exact`.
    Raises FormatError if it is no model.
    """
    if path.is_file() and is_ply(path) and not ply_exported(path):
        for line in describe_faults(path):
            say(line)
        yield path
        return
    say_missing_sky(path)
    with TemporaryDirectory(prefix="panolog-model-") as folder:
        ply = Path(folder) / f"{path.stem}.ply"
        convert_to_ply(path, ply, frame(), exact=exact)
        yield ply
