"""Writes posed panoramas and a cloud as a scene of ours, which appears whole or not at all."""

import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import write_colmap
from panolog.scene.errors import InputError, SceneError
from panolog.scene.files import SUFFIX, write_bytes
from panolog.scene.image_files import decode
from panolog.scene.offset import Offset, write_offset
from panolog.scene.read import read_scene

Sightings = tuple[NDArray[np.int64], NDArray[np.float64]]  # (M,) rows of the points, (M, 2) u/W and v/H
Progress = Callable[[int, int], None]  # steps done, steps in all
UNSEEN: Sightings = (np.empty(0, np.int64), np.empty((0, 2)))
_GREY = 128  # of points that no panorama shows


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One panorama. Camera axes x right, y down, z forward; X_cam = rotation @ X + translation."""

    name: str  # relative to the image folder of the scene
    file: Path
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)
    sightings: Sightings = UNSEEN  # which points it sees, and where as fractions of width and height


@dataclass(frozen=True, eq=False)
class NewScene:
    """What a scene is written from."""

    images: Sequence[PosedImage]  # sorted by name
    size: tuple[int, int]  # width and height of each
    points: NDArray[np.float64]  # (P, 3) world units
    colors: NDArray[np.uint8] | None  # (P, 3) RGB; None: the panoramas tell
    split: Mapping[str, Sequence[str]] | None = None  # stems by "train.txt" and "test.txt"; None: every 8th
    layers: Mapping[str, Sequence[Path | None]] | None = None  # by folder, for each image its file
    offset: Offset | None = None


def require_new(output: Path) -> None:
    """Raises SceneError if there is something at `output` already."""
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise SceneError(f"{output}: is there already; give a new folder")


def write_scene(output: Path, new: NewScene, *, link: bool, progress: Progress | None = None) -> None:
    """Writes `new` to the folder `output`, which must be new or empty.

    Args:
        link: link the panoramas and their layers instead of copying them.
        progress: called after each panorama.

    Raises:
        SceneError: it could not be trained; `output` is then untouched.
        OSError: a file cannot be read or written.
    """
    target = output.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}{SUFFIX}")
    try:
        _bring_files(temporary, new, link, progress)
        colors = _sampled(new.images, len(new.points)) if new.colors is None else new.colors
        write_colmap(
            temporary / "sparse" / "0",
            [(image.name, image.rotation, image.translation) for image in new.images],
            width=new.size[0],
            height=new.size[1],
            points=new.points,
            colors=colors,
            observations=[(rows, fractions * new.size) for rows, fractions in map(_once, new.images)],
        )
        for name, members in (new.split or {}).items():
            write_bytes(temporary / name, ("\n".join(members) + "\n").encode())
        if new.offset is not None:
            write_offset(temporary, new.offset)
        _check(temporary, output)
        temporary.replace(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _bring_files(folder: Path, new: NewScene, link: bool, progress: Progress | None) -> None:
    """The panoramas and their layers."""
    for done, image in enumerate(new.images, start=1):
        _bring(image.file, folder / "images" / image.name, link)
        for layer, files in (new.layers or {}).items():
            file = files[done - 1]
            if file is not None:
                _bring(file, (folder / layer / image.name).with_suffix(".png"), link)
        if progress is not None:
            progress(done, len(new.images))


def _bring(file: Path, target: Path, link: bool) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if link:
        target.symlink_to(file.resolve())
    else:
        shutil.copyfile(file, target)


def _once(image: PosedImage) -> Sightings:
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


def _check(temporary: Path, output: Path) -> None:
    """Reads the scene as training will; complaints name the folder that the user knows."""
    try:
        read_scene(temporary)
    except InputError as error:
        raise SceneError(str(error).replace(str(temporary), str(output))) from error
