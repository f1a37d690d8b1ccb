"""`panolog scene sfm`: from folders of panoramas and 360° videos to a scene."""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile, pictures_below
from panolog.prepare.sfm.features import MEMORY
from panolog.prepare.sfm.mapping import Mapper
from panolog.prepare.sfm.pairs import Pairing
from panolog.prepare.sfm.reconstruct import Reconstruction, reconstruct
from panolog.prepare.sfm.report import SfmReport, write_report
from panolog.prepare.sfm.sketch import Sketch, Sketcher
from panolog.prepare.sfm.trajectory import (
    Trajectory,
    check_times,
    fit_world,
    places_of,
    read_trajectory,
)
from panolog.prepare.sources.find import Sources, find_sources
from panolog.prepare.sources.gather import Gathered, gather
from panolog.prepare.video.frames import FrameChoice, frame_times
from panolog.prepare.world.exif import read_exif
from panolog.prepare.world.georeference import Georeference, georeference, scale_from_distance
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.files import natural_key, some_of, stem_of
from panolog.scene.write import NewScene, Offset, PosedImage, StageProgress, require_new, write_scene

_APART = 0.1  # of the spread of a trajectory: poses that differ more are wrong, or belong to another
WithMasks = Callable[[Sequence[PanoramaFile]], Sequence[PanoramaFile]]


@dataclass(frozen=True)
class SfmSettings(FrameChoice):
    """The options of `panolog scene sfm`."""

    pairing: Pairing = "auto"
    mapper: Mapper = "incremental"
    partial: bool = False  # accept poses for half of the panoramas or fewer
    parts: bool = False  # write each other part as a scene next to that of the largest
    gps: bool = True  # take metres and north from EXIF
    distance: tuple[str, str, float] | None = None  # names of two panoramas, and metres between them
    link: bool = False  # instead of copying
    trajectory: Path | None = None  # where the camera was, as TUM or CSV


def workspace_folder(output: Path) -> Path:
    """Where an unfinished job keeps its results: SCENE.sfm, next to the scene."""
    return output.with_name(f"{output.name}.sfm")


def make_scene(
    source: Path | Sequence[Path],
    output: Path,
    settings: SfmSettings,
    progress: StageProgress,
    with_masks: WithMasks = lambda panoramas: panoramas,
    memory: int = MEMORY,
    show: Callable[[Sketch], None] | None = None,
) -> SfmReport:
    """Makes a scene of `source` in the new folder `output`, with its report.

    Args: source, a folder or a video, or several; with_masks, gets the panoramas and returns them with masks
        that it has made; those of an interrupted job must stay as they are; memory, bytes that may be used;
        show, called with what is known of the place as poses are found.

    Raises SceneError if the source is wrong or its panoramas share too little: there is no `output` then, and
    what was done is kept for the next call. RunError if a process is killed, OSError if a file fails.
    """
    require_new(output)
    if settings.distance is not None and settings.trajectory is not None:
        raise ConfigError("--distance and --trajectory both say how large the world is; leave out one")
    known = None if settings.trajectory is None else read_trajectory(settings.trajectory)
    given = [source] if isinstance(source, Path) else source
    check_place(output, given)
    sources, folder = find_sources(given), workspace_folder(output.resolve())
    if known is not None:
        check_times(known, [it.is_video for it in sources.all])
    gathered = gather(sources, folder, settings, progress)
    settings = replace(settings, distance=_between(settings.distance, gathered.panoramas))
    panoramas = with_masks(gathered.panoramas)
    places = None if known is None else _places(known, sources, folder, panoramas)
    sketcher = None if show is None else Sketcher(panoramas, show, gps=settings.gps)
    if sketcher is not None:
        sketcher.begin()
    found = reconstruct(
        panoramas,
        folder,
        pairing=settings.pairing,
        mapper=settings.mapper,
        partial=settings.partial,
        progress=progress,
        memory=memory,
        places=places,
        sketcher=sketcher,
    )
    reports = [
        _report(part, number, settings, places, gathered, sources)
        for number, part in enumerate(found if settings.parts else found[:1], start=1)
    ]
    made = any(panorama.path.is_relative_to(folder) for panorama in panoramas)
    link = settings.link and not made  # the workspace is removed, with the frames and whole panoramas in it
    for report in reversed(reports):  # the first stands for all: it comes last
        _write(output, folder, report, link, progress)
    shutil.rmtree(folder, ignore_errors=True)
    return reports[0]


def _report(
    part: Reconstruction,
    number: int,
    settings: SfmSettings,
    places: NDArray[np.float64] | None,
    gathered: Gathered,
    sources: Sources,
) -> SfmReport:
    """A part in its world; places, (K, 3) where a trajectory has the panoramas."""
    world = _georeference(part, settings, number == 1)
    if places is not None and settings.trajectory is not None:
        world = _along(world, part, places[list(part.model.rows)], settings.trajectory)
    moved = replace(part, model=part.model.moved(world.similarity))
    notes, several = (*gathered.notes, *world.notes), sources.all if len(sources.all) > 1 else ()
    return SfmReport(moved, world, notes, gathered.left_out, number, several)


def _write(output: Path, folder: Path, report: SfmReport, link: bool, progress: StageProgress) -> None:
    """Writes the scene of a part, with its report: the first in SCENE, the second in SCENE-2.

    A scene that an earlier call has written is not written again. Args: folder, the workspace, which notes
        what scenes are of this job.
    """
    scene = output if report.number == 1 else output.with_name(f"{output.name}-{report.number}")
    begun = folder / f"{scene.name}.begun"
    if begun.exists() and scene.exists():
        return
    require_new(scene)
    begun.touch()
    write_scene(
        scene,
        new_scene(report.found, _offset(report.world)),
        link=link,
        progress=lambda d, n: progress("scene", d, n),
        complete=lambda folder: write_report(folder, report),
    )


def _between(
    distance: tuple[str, str, float] | None, panoramas: Sequence[PanoramaFile]
) -> tuple[str, str, float] | None:
    """The known distance, with names as the scene will have them: what was a TIFF may have become a PNG.

    Raises ConfigError, before hours are spent on poses, if it is none, or not between two of the panoramas.
    """
    if distance is None:
        return None
    names, (*given, metres) = {stem_of(it.name): it.name for it in panoramas}, distance
    first, second = (names.get(name, names.get(stem_of(name), "")) for name in given)
    for name, it in zip(given, (first, second), strict=True):
        if not it:
            some = some_of(sorted(names.values(), key=natural_key), "panorama")
            raise ConfigError(f"--distance: {name} is not there; name two of the {some}")
    if first == second:
        raise ConfigError(f"--distance {first} {second}: give two panoramas")
    if not 0 < metres < np.inf:
        raise ConfigError(f"--distance: {metres:g} m is not a distance; give metres above 0")
    return first, second, metres


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
    known: Trajectory, sources: Sources, folder: Path, panoramas: Sequence[PanoramaFile]
) -> NDArray[np.float64]:
    """(K, 3) where the trajectory has the panoramas. Args: folder, the workspace."""
    first, *others = sources.all
    times = frame_times(first.path, folder / "frames") if first.is_video and not others else None
    return places_of(known, [panorama.name for panorama in panoramas], times)


def new_scene(
    found: Reconstruction,
    offset: Offset | None,
    colors: NDArray[np.uint8] | None = None,
    split: Mapping[str, Sequence[str]] | None = None,
    known: Sequence[PosedImage] = (),
) -> NewScene:
    """The scene to be written, in the natural order of names: that of `found` is that of capture.

    Args: colors and split, as of `NewScene`; known, the first panoramas of the model, whose poses are kept
        bit by bit.
    """
    model = found.model
    kept = [it.quaternion for it in known]
    poses = zip_longest(model.rows, model.rotations, model.translations, model.sightings, kept)
    images = list[PosedImage]()
    for row, *pose in poses:
        panorama = found.panoramas[row]
        image = PosedImage(panorama.name, panorama.path, *pose)
        images.append(replace(image, layers=panorama.layers))
    images.sort(key=lambda image: natural_key(image.name))
    return NewScene(images, found.size, model.points, colors, split=split, offset=offset)


def check_place(output: Path, sources: Iterable[Path]) -> None:
    """Raises SceneError if a scene would be inside of what it is made from."""
    for path in sources:
        if pictures_below(path).resolve() in output.resolve().parents:
            raise SceneError(f"{output}: is inside {path}, whose pictures are read; give a folder elsewhere")


def _offset(world: Georeference) -> Offset | None:
    """What is known of the scale and the place of a world."""
    if world.gps is not None:
        return Offset(offset=(0.0, 0.0, 0.0), frame="ENU", origin=world.gps.fixes.origin)
    return Offset(offset=(0.0, 0.0, 0.0), metres=1.0) if world.metric else None
