"""Imports a scene: what a reader of another format has found becomes a scene of ours."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from panolog.prepare.importers.interface import ImportedScene, ImportSource
from panolog.prepare.importers.registry import FORMATS, choose
from panolog.prepare.sfm.triangulate import triangulate
from panolog.scene.check import MIN_CAMERAS, check_images, check_names
from panolog.scene.errors import InputError
from panolog.scene.new_scene import NewScene, PosedImage, Progress, require_new, write_scene
from panolog.scene.offset import Offset

_FAR = 100  # times the extent of the cameras: from there on float32 is too coarse


@dataclass(frozen=True)
class Report:
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
    progress: Progress | None = None,
) -> Report:
    """Reads a scene of another program and writes it to `output`, which appears whole or not at all.

    Args:
        source: what to import.
        output: the scene's folder, new or empty.
        format: a key of FORMATS; found out if None.
        link: link the panoramas instead of copying them.
        progress: called after each panorama.

    Raises:
        InputError: the source is wrong, or `output` holds something; `output` is then untouched.
        OSError: a file cannot be read or written.
    """
    require_new(output)
    kind = choose(source, format)
    parsed = FORMATS[kind].read(source)
    images = sorted(parsed.images, key=lambda image: image.name)
    if len(images) < MIN_CAMERAS:
        raise InputError(f"{source.path}: {len(images)} posed panoramas; at least {MIN_CAMERAS} are needed")
    check_names(source.path, [image.name for image in images])
    size = check_images([image.file for image in images])
    if not len(parsed.points):
        parsed, images = _triangulated(source, parsed, images, size)
    parsed, images, offset = _centred(parsed, images)
    split = _split(parsed, images)
    new = NewScene(images, size, parsed.points, parsed.colors, split=split, offset=offset)
    write_scene(output, new, link=link, progress=progress)
    notes = list(parsed.notes)
    if parsed.colors is None and not any(len(image.sightings[0]) for image in images):
        notes.append("the points have no colours and begin grey")
    seen = sum(len(image.sightings[0]) for image in images)
    return Report(kind, len(images), len(parsed.points), seen, tuple(notes))


def _triangulated(
    source: ImportSource, parsed: ImportedScene, images: Sequence[PosedImage], size: tuple[int, int]
) -> tuple[ImportedScene, list[PosedImage]]:
    """The same with points that the panoramas and their poses give."""
    found = triangulate(source.path, images, size)
    images = [
        replace(images[row], sightings=seen) for row, seen in zip(found.rows, found.sightings, strict=True)
    ]
    note = f"{len(found.points):,} points were triangulated: the source has poses only"
    notes = [*parsed.notes, note]
    return replace(parsed, images=images, points=found.points, colors=None, notes=notes), images


def _centred(
    parsed: ImportedScene, images: list[PosedImage]
) -> tuple[ImportedScene, list[PosedImage], Offset | None]:
    """The scene moved to the origin, if it is so far away that float32 would not do, and by how much."""
    centers = np.stack([-image.rotation.T @ image.translation for image in images])
    middle = centers.mean(axis=0)
    reach = np.linalg.norm(centers - middle, axis=1).max()
    if np.linalg.norm(middle) <= _FAR * reach:
        return parsed, images, None
    offset = np.rint(middle)
    images = [replace(image, translation=image.translation + image.rotation @ offset) for image in images]
    note = f"the world was moved to the origin: add {tuple(offset.tolist())} for the source's (offset.json)"
    moved = replace(parsed, images=images, points=parsed.points - offset, notes=[*parsed.notes, note])
    x, y, z = offset.tolist()
    return moved, images, Offset(offset=(x, y, z))


def _split(parsed: ImportedScene, images: Sequence[PosedImage]) -> dict[str, list[str]] | None:
    """train.txt and test.txt of the panoramas that there are, if both have some."""
    known = {str(Path(image.name).with_suffix("")) for image in images}
    train, test = (sorted(set(part) & known) for part in (parsed.train, parsed.test))
    if train and test and not set(train) & set(test):
        return {"train.txt": train, "test.txt": test}
    return None
