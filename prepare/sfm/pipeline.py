"""`panolog scene sfm`: from a folder of panoramas or a 360° video to a scene."""

import hashlib
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import SUFFIXES, PanoramaFile, look_into, masks_among, pictures_below
from panolog.prepare.sfm.features import MEMORY
from panolog.prepare.sfm.mapping import Mapper
from panolog.prepare.sfm.pairs import Pairing
from panolog.prepare.sfm.reconstruct import LayerFiles, Reconstruction, reconstruct
from panolog.prepare.sfm.report import SfmReport, write_report
from panolog.prepare.sfm.sketch import Sketch, Sketcher
from panolog.prepare.sfm.trajectory import Trajectory, fit_world, places_of, read_trajectory
from panolog.prepare.stitching.lenses import Up
from panolog.prepare.stitching.pictures import raw_pictures, stitch_pictures
from panolog.prepare.video.frames import PARALLAX, extract_frames, frame_times
from panolog.prepare.world.cropped import complete_panoramas
from panolog.prepare.world.exif import read_exif
from panolog.prepare.world.georeference import Georeference, georeference, scale_from_distance
from panolog.scene.errors import SceneError
from panolog.scene.read import DEPTHS, MASKS, MIN_CAMERAS, SKY_MASKS, check_names, find_layer
from panolog.scene.write import NewScene, Offset, PosedImage, StageProgress, require_new, write_scene

_APART = 0.1  # of the spread of a trajectory: poses that differ more are wrong, or belong to another
_LAYERS = (MASKS, SKY_MASKS, DEPTHS)
WithMasks = Callable[[Sequence[PanoramaFile], LayerFiles], LayerFiles]


@dataclass(frozen=True)
class SfmSettings:
    """The options of `panolog scene sfm`."""

    pairing: Pairing = "auto"
    mapper: Mapper = "incremental"
    partial: bool = False  # accept poses for half of the panoramas or fewer
    parts: bool = False  # write each other part as a scene next to that of the largest
    gps: bool = True  # take metres and north from EXIF
    distance: tuple[str, str, float] | None = None  # names of two panoramas, and metres between them
    parallax: float = PARALLAX  # degrees between two frames of a video
    frames: int | None = None  # of a video at most
    up: Up | None = None  # of pictures or a video that are to be stitched: where up is in the first circle
    link: bool = False  # instead of copying
    trajectory: Path | None = None  # where the camera was, as TUM or CSV


def workspace_folder(output: Path) -> Path:
    """Where an unfinished job keeps its results: SCENE.sfm, next to the scene."""
    return output.with_name(f"{output.name}.sfm")


def make_scene(
    source: Path,
    output: Path,
    settings: SfmSettings,
    progress: StageProgress,
    with_masks: WithMasks = lambda _, layers: layers,
    memory: int = MEMORY,
    show: Callable[[Sketch], None] | None = None,
) -> SfmReport:
    """Makes a scene of `source`, a folder or a video, in the new folder `output`, with its report.

    Args: with_masks, gets the panoramas and their layers, and returns the layers with masks that it has made;
        those of an interrupted job must stay as they are; memory, bytes that may be used; show, called with
        what is known of the place as poses are found.

    Raises SceneError if the source is wrong or its panoramas share too little: there is no `output` then, and
    what was done is kept for the next call. RunError if a process is killed, OSError if a file fails.
    """
    require_new(output)
    known = None if settings.trajectory is None else read_trajectory(settings.trajectory)
    folder, notes = workspace_folder(output.resolve()), list[str]()
    if pictures_below(source).resolve() in output.resolve().parents:
        raise SceneError(f"{output}: is inside {source}, whose pictures are read; give a folder elsewhere")
    source = _stitched(source, folder, settings, notes.append, progress)
    panoramas, layers, copies = _panoramas_of(source, folder, settings, notes.append, progress)
    layers = with_masks(panoramas, layers)
    places = None if known is None else _places(known, source, folder, panoramas)
    sketcher = None if show is None else Sketcher(panoramas, show, gps=settings.gps)
    if sketcher is not None:
        sketcher.begin()
    found = reconstruct(
        panoramas,
        layers,
        folder,
        pairing=settings.pairing,
        mapper=settings.mapper,
        partial=settings.partial,
        progress=progress,
        memory=memory,
        places=places,
        sketcher=sketcher,
    )
    left_out = (*copies, *look_into(pictures_below(source)).left_out)  # a file has nothing below it
    reports = [
        _report(part, number, settings, places, notes, left_out)
        for number, part in enumerate(found if settings.parts else found[:1], start=1)
    ]
    made = any(panorama.path.is_relative_to(folder) for panorama in panoramas)
    link = settings.link and not made  # the workspace is removed, with the frames and whole panoramas in it
    for report in reversed(reports):  # the first stands for all: it comes last
        _write(output, report, link, progress)
    shutil.rmtree(folder, ignore_errors=True)
    return reports[0]


def _stitched(
    source: Path,
    folder: Path,
    settings: SfmSettings,
    note: Callable[[str], None],
    progress: StageProgress,
) -> Path:
    """The folder with the panoramas of pictures that are not stitched; any other source as it is."""
    pictures = raw_pictures(pictures_below(source)) if source.is_dir() else []
    if not pictures:
        return source
    stitch_pictures(
        pictures,
        pictures_below(source),
        folder / "stitched",
        up=settings.up,
        progress=lambda done, total: progress("stitching", done, total),
        note=note,
    )
    return folder / "stitched"


def _panoramas_of(
    source: Path,
    folder: Path,
    settings: SfmSettings,
    note: Callable[[str], None],
    progress: StageProgress,
) -> tuple[tuple[PanoramaFile, ...], LayerFiles, list[str]]:
    """The panoramas of a source, their layers, and a line for each copy among them.

    Args: folder, for what is made of the source; note, called with a line about what a video lacks.
    """
    if not source.is_file():
        given, layers, copies = without_copies(*panoramas_in_folder(source))
        whole = complete_panoramas(given, folder / "whole", lambda d, n: progress("metadata", d, n))
        return whole, layers, copies
    files = extract_frames(
        source,
        folder / "frames",
        parallax=settings.parallax,
        most=settings.frames,
        up=settings.up,
        progress=lambda done, total: progress("frames", done, total),
        note=note,
    )
    panoramas = tuple(PanoramaFile(folder / "frames", file.name, file) for file in files)
    return panoramas, {MASKS: find_layer(folder / "frames", MASKS, [file.name for file in files])}, []


def _report(
    part: Reconstruction,
    number: int,
    settings: SfmSettings,
    places: NDArray[np.float64] | None,
    notes: Sequence[str],
    left_out: tuple[str, ...],
) -> SfmReport:
    """A part in its world; places, (K, 3) where a trajectory has the panoramas."""
    world = _georeference(part, settings, number == 1)
    if places is not None and settings.trajectory is not None:
        world = _along(world, part, places[list(part.model.rows)], settings.trajectory)
    moved = replace(part, model=part.model.moved(world.similarity))
    return SfmReport(moved, world, (*notes, *world.notes), left_out, number)


def _write(output: Path, report: SfmReport, link: bool, progress: StageProgress) -> None:
    """Writes the scene of a part, with its report: the first in SCENE, the second in SCENE-2."""
    scene = output if report.number == 1 else output.with_name(f"{output.name}-{report.number}")
    new = _scene(report.found, report.world)
    write_scene(scene, new, link=link, progress=lambda d, n: progress("scene", d, n))
    write_report(scene, report)


def panoramas_in_folder(source: Path) -> tuple[tuple[PanoramaFile, ...], LayerFiles]:
    """The panoramas in a folder, or in its folder images or imgs, and the layers next to or among them.

    A picture NAME_mask.png next to NAME.jpg is its mask.

    Raises SceneError: there is no such folder, there are fewer than two panoramas, or their names collide.
    """
    if not source.is_dir():
        raise SceneError(f"{source}: there is no such folder or video")
    inner = pictures_below(source)
    content = look_into(inner)
    images = [path for path in content.images if path.relative_to(inner).parts[0] not in _LAYERS]
    among = masks_among(images)
    files = [path for path in images if path not in among.values()]
    if len(files) < MIN_CAMERAS:
        reason = "; ".join([f"at least {MIN_CAMERAS} are needed", *content.left_out])
        raise SceneError(f"{inner}: {len(files)} panoramas ({', '.join(sorted(SUFFIXES))}); {reason}")
    names = tuple(path.relative_to(inner).as_posix() for path in files)
    check_names(inner, names)
    is_root = inner != source or any((source / layer).is_dir() for layer in _LAYERS)
    root = source if is_root else source.parent
    layers = {layer: find_layer(root, layer, names) for layer in _LAYERS}
    layers[MASKS] = [mask or among.get(file) for mask, file in zip(layers[MASKS], files, strict=True)]
    return tuple(PanoramaFile(root, name, file) for name, file in zip(names, files, strict=True)), layers


def without_copies(
    panoramas: Sequence[PanoramaFile], layers: LayerFiles
) -> tuple[tuple[PanoramaFile, ...], LayerFiles, list[str]]:
    """The panoramas whose files differ, their layers, and a line for each other one: it shows nothing more.

    Raises: SceneError, fewer than two differ.
    """
    sizes = Counter(panorama.path.stat().st_size for panorama in panoramas)
    first, kept, lines = dict[bytes, str](), list[int](), list[str]()
    for row, panorama in enumerate(panoramas):
        if sizes[panorama.path.stat().st_size] > 1:
            digest = hashlib.sha256(panorama.path.read_bytes()).digest()
            if digest in first:
                lines.append(f"{panorama.name}: is a copy of {first[digest]}, left out")
                continue
            first[digest] = panorama.name
        kept.append(row)
    if len(kept) < MIN_CAMERAS:
        raise SceneError(
            f"{panoramas[0].root}: all panoramas are copies of {panoramas[0].name}; give different ones"
        )
    chosen = {layer: [files[row] for row in kept] for layer, files in layers.items()}
    return tuple(panoramas[row] for row in kept), chosen, lines


def _georeference(found: Reconstruction, settings: SfmSettings, first: bool) -> Georeference:
    """The frame of the world: gravity, GPS, a known distance, if it is in this part or this is the first."""
    panoramas = [found.panoramas[row] for row in found.model.rows]
    exifs = [read_exif(panorama.path) for panorama in panoramas]
    scale = None
    names = [panorama.name for panorama in panoramas]
    if settings.distance is not None and (first or set(settings.distance[:2]) <= set(names)):
        scale = scale_from_distance(names, found.model.centers, *settings.distance)
    return georeference(
        found.model.rotations,
        found.model.centers,
        [exif.attitude for exif in exifs],
        [exif.fix if settings.gps else None for exif in exifs],
        scale=scale,
    )


def _along(
    world: Georeference, found: Reconstruction, places: NDArray[np.float64], path: Path
) -> Georeference:
    """The world of a trajectory. Raises SceneError if the poses differ from it."""
    fit = fit_world(found.model.centers, places)
    if fit is None:
        return replace(
            world, notes=(*world.notes, f"{path.name} does not spread in two directions: not used")
        )
    similarity, left = fit
    reach = float(np.linalg.norm(np.nanstd(places, axis=0)))
    if left > _APART * reach:
        raise SceneError(
            f"{path}: the poses differ from it by {left:.2f} m, of {reach:.1f} m that it spreads; its names "
            "or times may be those of other panoramas; correct it, or leave out --trajectory"
        )
    note = f"the world is that of {path.name}, which the poses follow to {left:.2f} m"
    return Georeference(similarity, "arbitrary", True, world.up, None, (*world.notes, note))


def _places(
    known: Trajectory, source: Path, folder: Path, panoramas: Sequence[PanoramaFile]
) -> NDArray[np.float64]:
    """(K, 3) where the trajectory has the panoramas. Args: folder, the workspace."""
    times = frame_times(source, folder / "frames") if source.is_file() else None
    return places_of(known, [panorama.name for panorama in panoramas], times)


def _scene(found: Reconstruction, world: Georeference) -> NewScene:
    """The scene to be written."""
    model = found.model
    offset = None
    if world.metric:
        offset = Offset(offset=(0.0, 0.0, 0.0), metres=1.0)
    if world.gps is not None:
        offset = Offset(offset=(0.0, 0.0, 0.0), frame="ENU", origin=world.gps.fixes.origin)
    images = [
        PosedImage(found.panoramas[row].name, found.panoramas[row].path, rotation, translation, sightings)
        for row, rotation, translation, sightings in zip(
            model.rows, model.rotations, model.translations, model.sightings, strict=True
        )
    ]
    return NewScene(
        images,
        found.size,
        model.points,
        colors=None,
        layers={layer: [files[row] for row in model.rows] for layer, files in found.layers.items()},
        offset=offset,
    )
