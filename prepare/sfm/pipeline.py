"""`panolog scene sfm`: from a folder of panoramas or a 360° video to a scene."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from panolog.prepare.panorama_files import SUFFIXES, PanoramaFile, find_image_files
from panolog.prepare.sfm.mapping import Mapper
from panolog.prepare.sfm.pairs import Pairing
from panolog.prepare.sfm.reconstruct import LayerFiles, Reconstruction, reconstruct
from panolog.prepare.sfm.workspace import StageProgress
from panolog.prepare.video.frames import PARALLAX, extract_frames
from panolog.prepare.world.exif import read_exif
from panolog.prepare.world.georeference import Georeference, georeference, scale_from_distance
from panolog.scene.check import MIN_CAMERAS, check_names
from panolog.scene.errors import InputError
from panolog.scene.new_scene import NewScene, PosedImage, require_new, write_scene
from panolog.scene.pano360 import DEPTHS, MASKS, SKY_MASKS, find_layer

_LAYERS = (MASKS, SKY_MASKS, DEPTHS)


@dataclass(frozen=True)
class SfmSettings:
    """What a user may choose."""

    pairing: Pairing = "auto"
    mapper: Mapper = "incremental"
    partial: bool = False  # half of the panoramas or fewer will do
    gps: bool = True  # what EXIF says gives metres and north
    distance: tuple[str, str, float] | None = None  # metres between two panoramas
    parallax: float = PARALLAX  # degrees between two frames of a video
    frames: int | None = None  # of a video at most
    link: bool = False  # instead of copying


@dataclass(frozen=True, eq=False)
class SfmResult:
    """A scene, and how it came about."""

    found: Reconstruction  # in the scene's world
    world: Georeference
    notes: tuple[str, ...]  # of the source, a line each


def workspace_folder(output: Path) -> Path:
    """Where an unfinished job keeps what it has: SCENE.sfm, beside the scene."""
    return output.with_name(f"{output.name}.sfm")


def make_scene(source: Path, output: Path, settings: SfmSettings, progress: StageProgress) -> SfmResult:
    """Makes a scene of `source`, a folder or a video, in the new folder `output`.

    Raises:
        InputError: the source is wrong or its panoramas do not come together; there is no `output` then, and
            what was done is kept for the next try.
        OSError: a file cannot be read or written.
    """
    require_new(output)
    folder, notes = workspace_folder(output.resolve()), list[str]()
    if _inner(source).resolve() in output.resolve().parents:
        raise InputError(f"{output}: is inside {source}, whose pictures are read; give a folder elsewhere")
    if source.is_file():
        pictures, layers = _frames(source, folder / "frames", settings, progress, notes)
    else:
        pictures, layers = panoramas_in_folder(source)
    found = reconstruct(
        pictures,
        layers,
        folder,
        pairing=settings.pairing,
        mapper=settings.mapper,
        partial=settings.partial,
        progress=progress,
    )
    world = _place(found, settings)
    moved = world.similarity
    poses = moved.poses(found.model.rotations, found.model.translations)
    model = replace(
        found.model, rotations=poses[0], translations=poses[1], points=moved.points(found.model.points)
    )
    found = replace(found, model=model)
    link = settings.link and not source.is_file()  # the frames go with the folder that is kept
    write_scene(output, _scene(found, world), link=link, progress=lambda d, n: progress("scene", d, n))
    shutil.rmtree(folder, ignore_errors=True)
    return SfmResult(found, world, tuple(notes))


def panoramas_in_folder(source: Path) -> tuple[tuple[PanoramaFile, ...], LayerFiles]:
    """The panoramas in a folder, or in its folder images or imgs, and the layers beside or among them.

    Raises:
        InputError: there is no such folder, there are fewer than two panoramas, or their names collide.
    """
    if not source.is_dir():
        raise InputError(f"{source}: there is no such folder or video")
    inner = _inner(source)
    files = [path for path in find_image_files(inner) if path.relative_to(inner).parts[0] not in _LAYERS]
    if len(files) < MIN_CAMERAS:
        kinds = ", ".join(sorted(SUFFIXES))
        raise InputError(f"{inner}: {len(files)} panoramas ({kinds}); at least {MIN_CAMERAS} are needed")
    names = tuple(path.relative_to(inner).as_posix() for path in files)
    check_names(inner, names)
    beside = inner != source or any((source / layer).is_dir() for layer in _LAYERS)
    root = source if beside else source.parent
    layers = {layer: find_layer(root, layer, names) for layer in _LAYERS}
    return tuple(map(PanoramaFile, [root] * len(names), names, files)), layers


def _inner(source: Path) -> Path:
    """Where the pictures of a folder are."""
    return next((source / name for name in ("images", "imgs") if (source / name).is_dir()), source)


def _frames(
    video: Path, folder: Path, settings: SfmSettings, progress: StageProgress, notes: list[str]
) -> tuple[tuple[PanoramaFile, ...], LayerFiles]:
    """The frames of a video."""
    files = extract_frames(
        video,
        folder,
        parallax=settings.parallax,
        most=settings.frames,
        progress=lambda done, total: progress("frames", done, total),
        note=notes.append,
    )
    return tuple(PanoramaFile(folder, file.name, file) for file in files), {}


def _place(found: Reconstruction, settings: SfmSettings) -> Georeference:
    """The frame of the world: gravity, GPS, a known distance."""
    pictures = [found.pictures[row] for row in found.model.rows]
    said = [read_exif(picture.path) for picture in pictures]
    scale = None
    if settings.distance is not None:
        names = [picture.name for picture in pictures]
        scale = scale_from_distance(names, found.model.centers, *settings.distance)
    return georeference(
        found.model.rotations,
        found.model.centers,
        [exif.attitude for exif in said],
        [exif.fix if settings.gps else None for exif in said],
        scale=scale,
    )


def _scene(found: Reconstruction, world: Georeference) -> NewScene:
    """What is to be written."""
    model = found.model
    images = [
        PosedImage(found.pictures[row].name, found.pictures[row].path, rotation, translation, sightings)
        for row, rotation, translation, sightings in zip(
            model.rows, model.rotations, model.translations, model.sightings, strict=True
        )
    ]
    return NewScene(
        images,
        found.size,
        model.points,
        colors=None,
        layers={layer: _of_rows(files, model.rows) for layer, files in found.layers.items()},
        offset=world.located.offset if world.located is not None else None,
    )


def _of_rows(files: Sequence[Path | None], rows: Sequence[int]) -> list[Path | None]:
    return [files[row] for row in rows]
