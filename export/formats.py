"""The formats of models as single files or folders: what is written of a model, in which frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from panolog.export.compressed_ply import write_compressed_ply
from panolog.export.frame import Frame
from panolog.export.georeference import Georeference
from panolog.export.gltf.glb import write_glb
from panolog.export.gltf.tiles import write_tiles
from panolog.export.reading import sky_of
from panolog.export.sky import render_sky, write_sky_image
from panolog.export.sog.write import write_sog
from panolog.export.splats import ModelSource, Part, Selection, Surroundings
from panolog.export.spz import LARGEST, REACH, Version, write_spz
from panolog.scene.errors import InputError
from panolog.scene.gaussians import Gaussians
from panolog.scene.ply import ply_exact, read_sky, write_ply_parts

_FEW = 0.01  # of a scene's Gaussians, at most, that are left out because they are too far


@dataclass(frozen=True, eq=False)
class ChosenModel:
    """A model, and what of it is written."""

    ply: Path
    place: Georeference
    selection: Selection = field(default_factory=Selection)  # its part is that of each format
    sky: bool = True  # whether files that can hold it have the sky
    levels: int | None = None  # of detail of 3D Tiles; None = as many as it takes
    spz: Version = 3
    say: Callable[[str], None] = lambda _: None  # is called with what a format cannot hold of it


def write_format(kind: str, model: ChosenModel, path: Path) -> list[Path]:
    """Writes a model in a format of `_WRITERS`, atomically; returns the files and folders.

    Raises InputError if the model is damaged, nothing is left of it, or it does not fit; OSError.
    """
    return _WRITERS[kind](model, path) or [path]


def _source(model: ChosenModel, part: Part, frame: Frame | None = None, scale: float = 1.0) -> ModelSource:
    """Raises InputError if nothing is left of the model."""
    selection = replace(model.selection, part=part)
    found = ModelSource(model.ply, selection, frame or model.place.frame, scale)
    if not found.count:
        raise InputError(f"{model.ply}: nothing is left of it; select more")
    return found


def _for_viewers(model: ChosenModel) -> ModelSource:
    """What viewers show of a model: turned y down, with its sky in the same file. Raises as `_source`."""
    upside_down = model.place.upside_down
    if not model.sky:
        return _source(model, "scene", upside_down)
    return _source(model, "all", upside_down).with_near_sky()


def _in_reach(model: ChosenModel, scene: ModelSource) -> ModelSource:
    """A scene without the few Gaussians that are farther than SPZ holds: some of a flight are at the horizon.

    A scene of which more is that far is returned whole, and SPZ refuses it.
    """
    middle, selection = Surroundings(scene.frame.origin[None], REACH / scene.scale), scene.selection
    near = replace(scene, selection=replace(selection, near=(*selection.near, middle)))
    left = scene.count - near.count
    if not 0 < left <= _FEW * scene.count:
        return scene
    model.say(
        f"{left:,} of {scene.count:,} Gaussians are more than {REACH:.0f} units from the origin of exports, "
        "which SPZ, glTF and 3D Tiles do not hold: left out"
    )
    return near


def _tiles(model: ChosenModel, path: Path) -> None:
    write_tiles(path, _in_metres(model), to_ecef=model.place.tiles_to_ecef(), levels=model.levels)


def _spz(model: ChosenModel, path: Path) -> list[Path]:
    """The sky, whose size SPZ may not hold, is a file of its own: pulled in, so that it looks the same."""
    write_spz(path, _in_reach(model, _source(model, "scene")), model.spz)
    sky = sky_of(path)
    if not model.sky or not len(read_sky(model.ply)):
        sky.unlink(missing_ok=True)  # of an earlier export, which readers of the scene would take for its own
        return [path]
    write_spz(sky, _source(model, "sky").within(REACH, LARGEST), model.spz)
    return [path, sky]


def _ply(model: ChosenModel, path: Path) -> None:
    """Writes a PLY with the columns of every trainer, turned y down: viewers turn such a file upright."""
    if path.resolve() == model.ply.resolve():
        raise InputError(f"{path}: is the model itself; give the upright one another name")
    found, sky = _for_viewers(model), 0
    if model.sky:
        sky = found.part("sky").count
    exact, first = ply_exact(model.ply), found.count - sky

    def parts() -> Iterator[Gaussians]:
        done = 0
        for piece in found.pieces():
            done += len(piece)
            yield replace(piece.gaussians(exact=exact), sky=max(0, min(len(piece), done - first)))

    write_ply_parts(path, parts(), count=found.count, sky=sky, exact=exact, exported=found.degree)


def _in_metres(model: ChosenModel) -> ModelSource:
    """The scene in the unit of glTF and 3D Tiles, where it is known how large one of the model's is."""
    return _in_reach(model, _source(model, "scene", scale=model.place.unit or 1.0))


def _sky_image(model: ChosenModel, path: Path) -> list[Path]:
    sky = read_sky(model.ply)
    if not len(sky):
        raise InputError(f"{model.ply}: has no sky; leave out --sky-image")
    image, paths = render_sky(sky, model.place.frame), [path, path.with_suffix(".exr")]
    for file in paths:
        write_sky_image(file, image)
    return paths


# Those that write more than the path return what they have written.
_WRITERS: dict[str, Callable[[ChosenModel, Path], list[Path] | None]] = {
    "sog": lambda model, path: write_sog(path, _for_viewers(model)),
    "spz": _spz,
    "compressed-ply": lambda model, path: write_compressed_ply(path, _for_viewers(model)),
    "ply": _ply,
    "glb": lambda model, path: write_glb(path, _in_metres(model)),
    "3dtiles": _tiles,
    "sky-image": _sky_image,
}
