"""Writes what an importer has read as a scene of ours: a COLMAP model, panoramas and the split."""

import json
import secrets
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.check import MIN_CAMERAS, check_images, check_names
from panolog.scene.colmap import write_colmap
from panolog.scene.errors import InputError
from panolog.scene.files import SUFFIX, write_bytes
from panolog.scene.image_files import decode
from panolog.scene.importers.parsed import Parsed, PosedImage, Source
from panolog.scene.importers.registry import FORMATS, choose
from panolog.scene.importers.triangulate import triangulate
from panolog.scene.read import read_scene

Progress = Callable[[int, int], None]  # panoramas brought over, panoramas in all
_GREY = 128  # of points that no panorama shows
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
    source: Source,
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
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output}: is there already; give a new folder")
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
    target = output.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{SUFFIX}")
    try:
        _write(temporary, parsed, images, size, link, progress)
        if offset.any():
            write_bytes(temporary / "offset.json", json.dumps({"offset": offset.tolist()}).encode())
        _check(temporary, output)
        temporary.replace(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    notes = list(parsed.notes)
    if parsed.colors is None and not any(len(image.sightings[0]) for image in images):
        notes.append("the points have no colours and begin grey")
    seen = sum(len(image.sightings[0]) for image in images)
    return Report(kind, len(images), len(parsed.points), seen, tuple(notes))


def _triangulated(
    source: Source, parsed: Parsed, images: Sequence[PosedImage], size: tuple[int, int]
) -> tuple[Parsed, list[PosedImage]]:
    """The same with points that the panoramas and their poses give."""
    points, colors, sightings = triangulate(source.path, images, size)
    images = [replace(image, sightings=seen) for image, seen in zip(images, sightings, strict=True)]
    note = f"{len(points):,} points were triangulated: the source has poses only"
    return replace(parsed, images=images, points=points, colors=colors, notes=[*parsed.notes, note]), images


def _centred(
    parsed: Parsed, images: list[PosedImage]
) -> tuple[Parsed, list[PosedImage], NDArray[np.float64]]:
    """The scene moved to the origin, if it is so far away that float32 would not do, and by how much (3,)."""
    centers = np.stack([-image.rotation.T @ image.translation for image in images])
    middle = centers.mean(axis=0)
    reach = np.linalg.norm(centers - middle, axis=1).max()
    if np.linalg.norm(middle) <= _FAR * reach:
        return parsed, images, np.zeros(3)
    offset = np.rint(middle)
    images = [replace(image, translation=image.translation + image.rotation @ offset) for image in images]
    note = f"the world was moved to the origin: add {tuple(offset.tolist())} for the source's (offset.json)"
    moved = replace(parsed, images=images, points=parsed.points - offset, notes=[*parsed.notes, note])
    return moved, images, offset


def _write(
    folder: Path,
    parsed: Parsed,
    images: Sequence[PosedImage],
    size: tuple[int, int],
    link: bool,
    progress: Progress | None,
) -> None:
    """The scene in `folder`; `size` is the panoramas' width and height."""
    for done, image in enumerate(images, start=1):
        target = folder / "images" / image.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if link:
            target.symlink_to(image.file.resolve())
        else:
            shutil.copyfile(image.file, target)
        if progress is not None:
            progress(done, len(images))
    colors = parsed.colors
    write_colmap(
        folder / "sparse" / "0",
        [(image.name, image.rotation, image.translation) for image in images],
        width=size[0],
        height=size[1],
        points=parsed.points,
        colors=_sampled(images, len(parsed.points)) if colors is None else colors,
        observations=[(rows, fractions * size) for rows, fractions in map(_once, images)],
    )
    _write_split(folder, parsed, {str(Path(image.name).with_suffix("")) for image in images})


def _once(image: PosedImage) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The sightings of an image, each point at most once."""
    rows, fractions = image.sightings
    _, first = np.unique(rows, return_index=True)
    return rows[first], fractions[first]


def _sampled(images: Sequence[PosedImage], points: int) -> NDArray[np.uint8]:
    """(points, 3) the mean RGB of the pixels where each point is seen."""
    total, count = np.zeros((points, 3)), np.zeros(points)
    for image in images:
        rows, fractions = image.sightings
        if len(rows):
            pixels = decode(image.file, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            limit = np.array([pixels.shape[1], pixels.shape[0]])
            u, v = np.clip(np.floor(fractions * limit), 0, limit - 1).astype(np.int64).T
            np.add.at(total, rows, pixels[v, u, ::-1])
            np.add.at(count, rows, 1)
    mean = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], _GREY)
    return np.rint(mean).astype(np.uint8)


def _write_split(folder: Path, parsed: Parsed, known: set[str]) -> None:
    """train.txt and test.txt of the panoramas that there are, if both have some."""
    train, test = (sorted(set(part) & known) for part in (parsed.train, parsed.test))
    if train and test and not set(train) & set(test):
        for name, members in (("train.txt", train), ("test.txt", test)):
            write_bytes(folder / name, ("\n".join(members) + "\n").encode())


def _check(temporary: Path, output: Path) -> None:
    """Reads the scene as training will; complaints name the folder that the user knows."""
    try:
        read_scene(temporary)
    except InputError as error:
        raise InputError(str(error).replace(str(temporary), str(output))) from error
