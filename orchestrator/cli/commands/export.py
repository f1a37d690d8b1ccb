"""`panolog export`: a run's model, or any model, as files that others open."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from panolog.export.formats import ChosenModel, write_format
from panolog.export.frame import Frame
from panolog.export.georeference import Georeference, georeference_of
from panolog.export.gltf.tiles import TILESET
from panolog.export.site.write import DESCRIPTION
from panolog.export.splats import Selection, Surroundings
from panolog.export.spz import Version
from panolog.orchestrator.cli.commands.models import say_unmerged
from panolog.orchestrator.cli.session.delivery import provenance
from panolog.orchestrator.engine.stages.scenes import scene_of
from panolog.orchestrator.runs.folder import RunFolder, model_of, write_json
from panolog.orchestrator.runs.info import read_info
from panolog.orchestrator.watch.views.site.build import (
    Wanted,
    site_of_file,
    site_of_run,
    write_folder,
    written_place,
)
from panolog.orchestrator.watch.views.site.viewpoints import read_viewpoints
from panolog.scene.errors import ConfigError, InputError
from panolog.scene.ply import describe_faults
from panolog.scene.write import StageProgress

# By option, the ending of what it writes.
FORMATS = {
    "sog": ".sog",
    "web": "-web",
    "spz": ".spz",
    "compressed-ply": ".compressed.ply",
    "ply": ".ply",
    "glb": ".glb",
    "3dtiles": "-3dtiles",
    "sky-image": ".jpg",
}
_GEOREFERENCE = "georef.json"


@dataclass(frozen=True)
class ExportSpec:
    """What to export of a model, and how."""

    formats: tuple[str, ...]  # of FORMATS; none = by the ending of the output
    selection: Selection = field(default_factory=Selection)  # its part is that of each format
    max_distance: float | None = None  # units of the model, from the nearest camera of the run
    sky: bool = True  # whether files that can hold it have the sky
    levels: int | None = None  # of detail, of streamed formats; None = as many as it takes
    spz: Version = 3
    up: tuple[float, float, float] | None = None  # in the model's coordinates; None = as the scene has it
    epsg: int | None = None  # of the source's coordinates, instead of what the scene says
    metres: float | None = None  # of a unit, likewise
    geoid: float | None = None  # metres above the ellipsoid, likewise: heights are above the sea


@dataclass(frozen=True, eq=False)
class _Model:
    """A model to export."""

    run: RunFolder | None
    ply: Path
    name: str
    place: Georeference
    made_of: dict[str, Any]


def export_model(
    source: Path, output: Path, spec: ExportSpec, progress: StageProgress, say: Callable[[str], None]
) -> list[Path]:
    """Writes a model in some formats; returns what was written, files and folders.

    With one format whose ending `output` has, that is the file; else it is a folder, with georef.json.

    Args: source, the folder of a run or a PLY; say, is called with what the user should know of the model.
    Raises InputError if the source is no model, the place or a format does not fit, or `output` is of a run
    or exists as something else; OSError if it cannot be written.
    """
    torch.set_num_threads(1)  # small pieces: threads would only wait for each other
    model = _model(source, spec)
    formats = spec.formats or _by_ending(output)
    jobs: list[tuple[str, Path]] = [
        (kind, _place(output, model.name, kind, len(formats))) for kind in formats
    ]
    _spare_runs(output, [path for _, path in jobs])
    for _, path in jobs:
        path.parent.mkdir(parents=True, exist_ok=True)
    if spec.max_distance is not None:
        near = _surroundings(model, spec.max_distance)
        spec = replace(spec, selection=replace(spec.selection, near=(near,)))
    chosen = ChosenModel(model.ply, model.place, spec.selection, spec.sky, spec.levels, spec.spz, say)
    written: list[Path] = []
    for done, (kind, path) in enumerate(jobs):
        progress(f"writing {path.name}", done, len(jobs))
        written += _web(model, path, spec) if kind == "web" else write_format(kind, chosen, path)
    if output.is_dir() and written != [output]:
        write_json(output / _GEOREFERENCE, model.place.as_json(model.made_of))
        written.append(output / _GEOREFERENCE)
    faults = describe_faults(model.ply) if model.run is None else []
    if model.run is not None:
        say_unmerged(model.run, model.ply)
    for line in (*faults, *_doubts(model.place, formats)):
        say(line)
    progress("writing", len(jobs), len(jobs))
    return written


def _spare_runs(output: Path, paths: list[Path]) -> None:
    """Raises InputError if a run has made what would be written: its model, pages or georef.json."""
    if RunFolder(output).info.is_file():
        raise InputError(f"{output}: is the folder of a run; give a folder of its own")
    for path in paths:
        run = RunFolder(path.parent)
        if run.info.is_file() and path in (run.point_cloud, run.sky, run.web):
            raise InputError(f"{path}: belongs to the run; give it another name")


def _model(source: Path, spec: ExportSpec) -> _Model:
    folder = RunFolder(source) if source.is_dir() else None
    if folder is not None:
        info = read_info(folder)
        ply = model_of(folder)
        if ply.suffix != ".ply":
            raise InputError(f"{source}: has no model yet; wait for the end of Stage I")
        place, made_of, name = (
            _place_of(folder),
            provenance(info.scene.fingerprint, info.config, info.versions),
            folder.place.name,
        )
    else:
        ply, place, made_of, name = source, Georeference(), {}, source.stem
    if spec.epsg is not None:
        place = replace(place, origin=None, epsg=spec.epsg, metres=None, geoid=None)
    geoid = place.geoid if spec.geoid is None else spec.geoid
    place = replace(place, up=spec.up or place.up, metres=spec.metres or place.metres, geoid=geoid)
    _frame(place)
    _ = place.unit  # that it fits is known before anything is written
    return _Model(folder, ply, name, place, made_of)


def _surroundings(model: _Model, distance: float) -> Surroundings:
    """What is so near to a camera of the run. Raises InputError if no cameras are known."""
    viewpoints = read_viewpoints(model.run, None) if model.run else None
    if viewpoints is None:
        raise InputError(f"--max-distance: {model.ply} has no cameras; give the run that has made it")
    return Surroundings(viewpoints.positions, distance)


def _doubts(place: Georeference, formats: tuple[str, ...]) -> list[str]:
    """What of its place is not known, and matters for a globe."""
    if "3dtiles" not in formats or place.heights_known or place.to_ecef() is None:
        return []
    return [
        "heights are taken to be above the ellipsoid of WGS84; if they are above the sea, as those of maps "
        "and most GPS receivers, give with --geoid how high that is there above the ellipsoid"
    ]


def _place_of(folder: RunFolder) -> Georeference:
    """By its scene, or where that is not here by the run's georef.json. Raises InputError without both."""
    written = written_place(folder)
    try:
        return georeference_of(scene_of(read_info(folder), folder))
    except InputError as error:
        if written is None:
            raise InputError(f"{error}; without it nothing says where the model is") from error
    return written


def _frame(place: Georeference) -> Frame:
    try:
        return place.frame
    except ValueError as error:
        raise ConfigError(f"--up {error}") from error


def _by_ending(output: Path) -> tuple[str, ...]:
    found = [kind for kind, ending in FORMATS.items() if ending[0] == "." and output.name.endswith(ending)]
    if not found:
        options = ", ".join(f"--{kind}" for kind in FORMATS)
        raise InputError(f"{output}: which format? Give one of {options}, or a file that ends like it")
    return (found[0],)


def _place(output: Path, name: str, kind: str, count: int) -> Path:
    """Where a format is written."""
    ending = FORMATS[kind]
    folder = ending[0] != "."
    again = any((output / index).is_file() for index in (DESCRIPTION, TILESET))  # what this command has made
    if count == 1 and (folder or output.name.endswith(ending)) and (again or not output.is_dir()):
        return output
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; several formats go into a folder")
    stem = "sky" if kind == "sky-image" else name
    return output / (ending[1:] if folder else f"{stem}{ending}")


def _web(model: _Model, path: Path, spec: ExportSpec) -> list[Path]:
    place, levels = model.place, spec.levels
    wanted = Wanted(selection=spec.selection, sky=spec.sky, streams=True, levels=levels, place=place)
    shown = site_of_run(model.run, wanted) if model.run else site_of_file(model.ply, wanted)
    write_folder(shown, path)
    return [path]
