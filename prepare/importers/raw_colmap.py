"""COLMAP models, binary or text, with their observations; also with cameras that COLMAP does not know.

Read without COLMAP, because the files may be damaged or of a fork: every count is checked against the bytes
that are there before anything is made of it. Poses are those of the images, which COLMAP also writes when it
has rigs. Layout: COLMAP's src/colmap/scene/reconstruction_io_binary.cc and doc/format.rst.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.importers import raw_binary, raw_text
from panolog.prepare.importers.poses import LARGEST, Array
from panolog.prepare.importers.raw_records import NO_POINT, Points
from panolog.scene.colmap_check import RawCamera, model_suffix
from panolog.scene.errors import SceneError


@dataclass(frozen=True, eq=False)
class RawImage:
    """An image as the file has it; world-to-camera."""

    name: str
    camera: RawCamera
    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    pixels: Array  # (M, 2) of the observations of points, pixel centres at +0.5
    points: NDArray[np.int64]  # (M,) rows of the model's points


@dataclass(frozen=True, eq=False)
class RawModel:
    """A model; images in the file's order, points by their id."""

    images: list[RawImage]
    points: Array  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB


def model_folder(folder: Path) -> Path | None:
    """Where in `folder` a COLMAP model is: itself, sparse/0 or sparse; None if nowhere."""
    for candidate in (folder, folder / "sparse" / "0", folder / "sparse"):
        if all(
            any((candidate / f"{stem}{end}").is_file() for end in (".bin", ".txt"))
            for stem in ("cameras", "images")
        ):
            return candidate
    return None


def need_model(folder: Path) -> Path:
    """As `model_folder`. Raises SceneError if it is nowhere."""
    found = model_folder(folder)
    if found is None:
        raise SceneError(f"{folder}: there is no COLMAP model (cameras and images, .bin or .txt)")
    return found


def read_cameras(folder: Path) -> dict[int, RawCamera]:
    """The cameras by id.

    Raises:
        SceneError: damaged, or of a model that is neither a panorama nor a pinhole.
    """
    suffix = model_suffix(folder)
    path = folder / f"cameras{suffix}"
    cameras = raw_binary.cameras(path) if suffix == ".bin" else raw_text.cameras(path)
    return {camera.id: camera for camera in cameras}


def camera_models(folder: Path | None) -> set[str]:
    """The models of a folder's cameras, for whoever asks what it is; none where there is nothing readable."""
    try:
        return {camera.model for camera in read_cameras(folder).values()} if folder is not None else set()
    except SceneError:
        return set()


def read_raw(folder: Path) -> RawModel:
    """Reads cameras, images and points3D from `folder`.

    Raises:
        SceneError: a file is missing or damaged; the message names it and what in it.
        OSError: a file cannot be read.
    """
    cameras = read_cameras(folder)
    binary = model_suffix(folder) == ".bin"
    points = (
        raw_binary.points(folder / "points3D.bin") if binary else raw_text.points(folder / "points3D.txt")
    )
    ids, where, colors = _by_id(folder, points)
    path = folder / ("images.bin" if binary else "images.txt")
    entries = raw_binary.images(path) if binary else raw_text.images(path)
    images = []
    for name, camera, pose, pixels, seen in entries:
        if camera not in cameras:
            raise SceneError(f"{path}: {name}: there is no camera {camera}; export the model again")
        matrix, translation = _pose(path, name, pose)
        row = np.searchsorted(ids, seen)
        known = (seen != NO_POINT) & (row < len(ids))
        known[known] = ids[row[known]] == seen[known]
        if not (np.abs(pixels[known]) < LARGEST).all():
            raise SceneError(f"{path}: {name}: an observation is not finite; export the model again")
        rows = row[known].astype(np.int64)
        images.append(RawImage(name, cameras[camera], matrix, translation, pixels[known], rows))
    return RawModel(images, where, colors)


def _by_id(folder: Path, points: Points) -> tuple[NDArray[np.uint64], Array, NDArray[np.uint8]]:
    """Ids (P,), ascending, places (P, 3) and colours (P, 3)."""
    ids = np.array(points.ids, np.uint64)
    order = np.argsort(ids, kind="stable")
    where = np.array(points.places, np.float64).reshape(-1, 3)[order]
    sound = (np.abs(where) < LARGEST).all(axis=1)
    if not sound.all():
        bad = ids[order][int(np.argmin(sound))]
        raise SceneError(f"{folder}: points3D: point {bad} is not finite; remove it")
    return ids[order], where, np.frombuffer(bytes(points.colors), np.uint8).reshape(-1, 3)[order]


def _pose(path: Path, name: str, pose: tuple[float, ...]) -> tuple[Array, Array]:
    w, x, y, z, *translation = pose
    if not all(abs(number) < LARGEST for number in pose) or abs(math.hypot(w, x, y, z) - 1) > 1e-3:
        raise SceneError(
            f"{path}: the pose of {name[:60]} is not finite, or its quaternion is not unit; repair it"
        )
    return Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(translation)
