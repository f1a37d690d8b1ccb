"""Which formats there are, and the import of a scene: found, read, completed, written."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from panolog.prepare.importers import (
    egonerf,
    metashape,
    nerfstudio,
    omnigs,
    openmvg,
    opensfm,
    panorama_sfm,
    pose_table,
    roam360,
    spheresfm,
)
from panolog.prepare.importers.interface import ImportedScene, ImportSource
from panolog.prepare.importers.masks import find_masks
from panolog.prepare.importers.spheresfm import find_model
from panolog.prepare.sfm.triangulate import triangulate
from panolog.scene.colmap import read_panoramas
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.files import natural_key, some_of, stem_of
from panolog.scene.image_files import check_images
from panolog.scene.model import NO_OFFSET, Vector
from panolog.scene.read import MASKS, MIN_CAMERAS, check_names, find_offset
from panolog.scene.write import NewScene, Offset, Origin, StageProgress, no_progress, require_new, write_scene


class ImportFormat(NamedTuple):
    """One format; see `interface`."""

    detect: Callable[[ImportSource], bool]
    read: Callable[[ImportSource], ImportedScene]


FORMATS: dict[str, ImportFormat] = {
    "openmvg": ImportFormat(openmvg.detect, openmvg.read),
    "omnigs": ImportFormat(omnigs.detect, omnigs.read),
    "opensfm": ImportFormat(opensfm.detect, opensfm.read),
    "nerfstudio": ImportFormat(nerfstudio.detect, nerfstudio.read),
    "360roam": ImportFormat(roam360.detect, roam360.read),
    "egonerf": ImportFormat(egonerf.detect_ricoh360, egonerf.read_ricoh360),
    "omniblender": ImportFormat(egonerf.detect_omniblender, egonerf.read_omniblender),
    "panorama_sfm": ImportFormat(panorama_sfm.detect, panorama_sfm.read),
    "spheresfm": ImportFormat(spheresfm.detect, spheresfm.read),
    "metashape": ImportFormat(metashape.detect, metashape.read),
    "poses": ImportFormat(pose_table.detect, pose_table.read),
}
_SPLIT = "train.txt", "test.txt"


def register_format(name: str, format: ImportFormat) -> None:
    """Adds a format, or replaces the one of that name: `import_scene` and `--format` then know it."""
    FORMATS[name] = format


@dataclass(frozen=True)
class ImportReport:
    """What has been imported."""

    format: str
    panoramas: int
    points: int
    observations: int
    notes: tuple[str, ...]  # one line each: what was left out


def import_scene(
    source: ImportSource,
    output: Path,
    *,
    format: str | None = None,
    link: bool = False,
    progress: StageProgress = no_progress,
) -> ImportReport:
    """Reads a scene of another program and writes it to `output`, which appears whole or not at all.

    Args:
        format: a key of FORMATS; detected if None.
        link: link the panoramas instead of copying them.
        progress: called with the name of each stage, such as "features", and how much of it is done.

    Raises InputError: the source is wrong, or `output` is not empty; `output` is then unchanged; OSError: a
    file cannot be read or written.
    """
    require_new(output)
    name = choose_format(source, format)
    imported = FORMATS[name].read(source)
    images = sorted(imported.images, key=lambda image: natural_key(image.name))
    if len(images) < MIN_CAMERAS:
        raise SceneError(f"{source.path}: {len(images)} posed panoramas; at least {MIN_CAMERAS} are needed")
    check_names(source.path, [image.name for image in images])
    size = check_images([image.file for image in images])
    scene = replace(imported, images=images)
    if not len(scene.points):
        scene = _triangulated(source, scene, size, progress)
    scene, offset = _centred(scene)
    masks, left_out = find_masks(source, images, scene.masks)
    split, lost = _split(scene, source)
    masked = [
        image if mask is None else replace(image, layers={MASKS: mask})
        for image, mask in zip(scene.images, masks, strict=True)
    ]
    new = NewScene(masked, size, scene.points, scene.colors, split=split, offset=offset)
    write_scene(output, new, link=link, progress=partial(progress, "import"))
    observations = sum(len(image.sightings[0]) for image in scene.images)
    notes = [*scene.notes, *left_out, *lost]
    if scene.colors is None and not observations:
        notes.append("the points have no colours and begin grey")
    return ImportReport(name, len(images), len(scene.points), observations, tuple(notes))


def choose_format(source: ImportSource, name: str | None) -> str:
    """The format: `name` if it is given, else the only one that recognizes the source.

    Raises InputError: there is no such format or source, or none or several formats recognize it.
    """
    if name is not None and name not in FORMATS:
        raise ConfigError(f"--format {name}: there is no such format; one of {', '.join(FORMATS)}")
    for path, option in ((source.path, ""), (source.images, "--images "), (source.points, "--points ")):
        if path is not None and not path.exists():
            raise SceneError(f"{option}{path}: there is no such file or folder")
    if name is not None:
        return name
    found = [key for key, format in FORMATS.items() if format.detect(source)]
    if not found and (folder := find_model(source.path)) is not None:
        read_panoramas(folder)  # reports what is wrong with a COLMAP model that no importer can read
    if len(found) != 1:
        what = f"could be {' or '.join(found)}" if found else "is of no format that can be imported"
        raise SceneError(f"{source.path}: {what}; say which with --format ({', '.join(FORMATS)})")
    return found[0]


def _triangulated(
    source: ImportSource, scene: ImportedScene, size: tuple[int, int], progress: StageProgress
) -> ImportedScene:
    """The scene with points from its panoramas and poses."""
    model = triangulate(source.path, scene.images, size, progress)
    images = [
        replace(scene.images[row], sightings=seen)
        for row, seen in zip(model.rows, model.sightings, strict=True)
    ]
    note = f"{len(model.points):,} points were triangulated: the source has poses only"
    return replace(scene, images=images, points=model.points, colors=None, notes=[*scene.notes, note])


def _centred(scene: ImportedScene) -> tuple[ImportedScene, Offset | None]:
    """The scene moved to the origin, if float32 is too coarse where it is, and the offset."""
    offset = find_offset(np.stack([-image.rotation.T @ image.translation for image in scene.images]))
    if offset is None:
        return scene, None if scene.place is None else _about(scene.place, NO_OFFSET)
    images = [replace(it, translation=it.translation + it.rotation @ offset) for it in scene.images]
    note = f"the world was moved to the origin: add {offset} for the source's (offset.json)"
    moved = replace(scene, images=images, points=scene.points - offset, notes=[*scene.notes, note])
    return moved, _about(scene.place, offset)


def _about(place: Origin | None, offset: Vector) -> Offset:
    """Where a world is that is metres east, north and up of a place on the earth, if there is one."""
    return Offset(offset=offset, frame=None if place is None else "ENU", origin=place)


def _split(scene: ImportedScene, source: ImportSource) -> tuple[dict[str, list[str]] | None, list[str]]:
    """The source's train.txt and test.txt, one or both, with the panoramas that exist; None if there is none.

    And one line for each thing that is left out of them.
    """
    known = {stem_of(image.name) for image in scene.images}
    parts = (scene.train, scene.test) if scene.train or scene.test else source.split()
    split = {name: set(part) for name, part in zip(_SPLIT, parts, strict=True) if part}
    if not split:
        return None, []
    lost = sorted(set().union(*split.values()) - known)
    notes = [f"{some_of(lost, 'name')} of the source's split: left out, as of no panorama"] if lost else []
    split = {name: part & known for name, part in split.items()}
    train, test = (split.get(name, known - split.get(other, set())) for name, other in permutations(_SPLIT))
    if train and test and not train & test:
        if unused := sorted(known - train - test):
            notes.append(f"{some_of(unused, 'panorama')}: not used, as in no part of the source's split")
        return {name: sorted(part) for name, part in split.items()}, notes
    left_out = "the source's split is left out: it has to name panoramas to train on and others to test"
    return None, [*notes, left_out]
