"""COLMAP models, read and written without COLMAP: files may be damaged or of a fork, and pycolmap large."""

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap_files import (
    CAMERA,
    COUNT,
    EQUIRECTANGULAR,
    EQUIRECTANGULAR_ID,
    FRAME,
    IMAGE,
    NO_POINT,
    PINHOLE,
    POINT,
    POINT2D,
    SIMPLE_PINHOLE,
    SPHERE,
    ColmapCamera,
    ImageRecord,
    read_cameras,
    read_frame_poses,
    read_image_records,
    read_point_records,
    unknown_camera,
)
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic, natural_key

_SENSOR = 0  # COLMAP's type of a sensor that is a camera
LARGEST = 1e12  # of any coordinate: a larger one is no place, and its square must stay a number
_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: text models have as few as four digits
# Name, rotation (3, 3) or quaternion (4,) w x y z, translation (3,).
Posed = tuple[str, NDArray[np.float64], NDArray[np.float64]]
Observations = tuple[NDArray[np.int64], NDArray[np.float64]]  # (M,) rows of the points, (M, 2) pixels


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """An image of a model; the pose is world-to-camera, as COLMAP writes it also where it has rigs."""

    name: str  # relative to the image folder
    camera: ColmapCamera
    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,)
    observed: NDArray[np.int64]  # (N,) rows of the model's points whose tracks have the image, ascending
    points: NDArray[np.int64]  # (M,) rows of the model's points, one for each observation
    pixels: NDArray[np.float64]  # (M, 2) of the observations, pixel centres at +0.5
    quaternion: NDArray[np.float64]  # (4,) w x y z of the rotation, as the file has it


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model; images in the file's order, points by their id."""

    images: list[ColmapImage]
    points: NDArray[np.float64]  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB


def read_panoramas(folder: Path) -> ColmapModel:
    """Reads a model of panoramas from `folder` without observations; images in natural order.

    A panorama is an EQUIRECTANGULAR camera, SphereSfM's SPHERE (which projects alike), or the dummy
    `PINHOLE W H W H W/2 H/2` of Pano360. A camera that no image has may be another one.

    Raises SceneError: the model is damaged, its poses are broken or its cameras are not panoramas; OSError: a
    file of it cannot be read.
    """
    model = read_colmap(folder, observations=False)
    for camera in {image.camera.id: image.camera for image in model.images}.values():
        _check_panorama(folder, camera)
    return replace(model, images=sorted(model.images, key=lambda image: natural_key(image.name)))


def read_colmap(folder: Path, *, observations: bool = True) -> ColmapModel:
    """Reads cameras, images and points3D from `folder`, binary if it has cameras.bin, else text.

    Raises SceneError: a file is missing or damaged; the message names it and what in it; OSError: a file
    cannot be read.
    """
    cameras = read_cameras(folder)
    records = list(read_image_records(folder, observations=observations))
    for number, pose in read_frame_poses(folder):
        _check_pose(folder, f"frame {number}", pose)
    if len({record.id for record in records}) < len(records):
        raise SceneError(f"{folder}: COLMAP cannot read the model: two images have one id; export it again")
    ids, points, colors, observed = _read_points(folder)
    images = [_image(folder, record, cameras, ids, observed) for record in records]
    return ColmapModel(images, points, colors)


def write_colmap(
    folder: Path,
    images: Sequence[Posed],
    *,
    width: int,
    height: int,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
    observations: Sequence[Observations],
) -> None:
    """Writes a binary COLMAP model with one EQUIRECTANGULAR camera.

    Each file appears atomically, points3D.bin last: where it is, the model is whole.

    Args:
        images: world-to-camera; images and points have ids from 1 in their order.
        width, height: pixels.
        points: (P, 3) world units.
        colors: (P, 3) RGB.
        observations: for each image the rows of the points that it sees and where, in pixels.
    """
    files = {
        "cameras.bin": _camera_records(width, height),
        "rigs.bin": _RIG,
        "frames.bin": _frame_records(images),
        "images.bin": _image_records(images, observations),
        "points3D.bin": _point_records(points, colors, [rows for rows, _ in observations]),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, records in files.items():
        with atomic(folder / name) as temporary, temporary.open("wb") as file:
            file.writelines(records)


_RIG = (struct.pack("<Q4I", 1, 1, 1, _SENSOR, 1),)  # one rig of one sensor, camera 1


def _camera_records(width: int, height: int) -> Iterator[bytes]:
    yield COUNT.pack(1) + CAMERA.pack(1, EQUIRECTANGULAR_ID, width, height)
    yield struct.pack("<2d", width, height)


def _frame_records(images: Sequence[Posed]) -> Iterator[bytes]:
    """A frame for each image, which is all that it has."""
    yield COUNT.pack(len(images))
    for number, (_, rotation, translation) in enumerate(images, 1):
        yield FRAME.pack(number, 1, *_quaternion(rotation), *translation, 1)
        yield struct.pack("<IIQ", _SENSOR, 1, number)


def _image_records(images: Sequence[Posed], observations: Sequence[Observations]) -> Iterator[bytes]:
    yield COUNT.pack(len(images))
    for number, ((name, rotation, translation), (rows, pixels)) in enumerate(
        zip(images, observations, strict=True), 1
    ):
        yield IMAGE.pack(number, *_quaternion(rotation), *translation, 1) + name.encode() + b"\0"
        seen = np.empty(len(rows), POINT2D)
        seen["xy"], seen["point"] = np.reshape(pixels, (-1, 2)), np.asarray(rows) + 1
        yield COUNT.pack(len(seen)) + seen.tobytes()


def _point_records(
    points: NDArray[np.float64], colors: NDArray[np.uint8], seen: Sequence[NDArray[np.int64]]
) -> Iterator[bytes]:
    """The points with their tracks. Args: seen, by image the rows of the points that it observes."""
    lengths = [len(rows) for rows in seen]
    track = np.empty((sum(lengths), 2), "<u4")  # image, number of the observation
    track[:, 0] = np.repeat(np.arange(1, len(seen) + 1), lengths)
    track[:, 1] = np.concatenate([*map(np.arange, lengths), np.empty(0)])
    rows = np.concatenate([*seen, np.empty(0, np.int64)])
    track = track[np.argsort(rows, kind="stable")]
    ends = np.cumsum(np.bincount(rows, minlength=len(points)))
    yield COUNT.pack(len(points))
    start = 0
    for number, (point, color, end) in enumerate(zip(points, colors, ends.tolist(), strict=True), 1):
        yield (
            POINT.pack(number, *point, *color, -1.0, end - start) + track[start:end].tobytes()
        )  # -1: no error
        start = end


def _quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """w x y z of a rotation (3, 3), from its largest value: as Eigen, and so COLMAP, computes it.

    A quaternion (4,) stays as it is.
    """
    if rotation.shape == (4,):
        return rotation
    R, trace = rotation, rotation[0, 0] + (rotation[1, 1] + rotation[2, 2])
    if trace > 0:
        root = math.sqrt(trace + 1)
        others = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
        return np.array([0.5 * root, *(0.5 / root * np.array(others))])
    i = int(np.argmax(np.diag(R)))
    j, k = (i + 1) % 3, (i + 2) % 3
    root = math.sqrt(R[i, i] - R[j, j] - R[k, k] + 1)
    found = np.empty(4)
    found[[0, 1 + j, 1 + k]] = np.array([R[k, j] - R[j, k], R[j, i] + R[i, j], R[k, i] + R[i, k]]) * (
        0.5 / root
    )
    found[1 + i] = 0.5 * root
    return found


def _check_panorama(folder: Path, camera: ColmapCamera) -> None:
    """Refuses what is no full 2:1 panorama."""
    W, H = camera.width, camera.height
    where = f"{folder}: camera {camera.id} ({camera.model}, {W} x {H})"
    if camera.model not in (EQUIRECTANGULAR, SPHERE, PINHOLE, SIMPLE_PINHOLE):
        raise unknown_camera(where, camera.model)
    if camera.model == SIMPLE_PINHOLE:
        raise SceneError(f"{where} is not a panorama; only full equirectangular panoramas can be used")
    if W != 2 * H:
        raise SceneError(f"{where} is not 2:1; only full equirectangular panoramas can be used")
    if camera.model == PINHOLE and camera.params != (W, H, W / 2, H / 2):
        raise SceneError(f"{where} is a real pinhole camera; a panorama has the dummy W H W H W/2 H/2")
    if camera.model == EQUIRECTANGULAR and camera.params != (W, H):
        raise SceneError(f"{where} has parameters other than its width and height; export it again")


def _read_points(
    folder: Path,
) -> tuple[NDArray[np.uint64], NDArray[np.float64], NDArray[np.uint8], dict[int, NDArray[np.int64]]]:
    """Ids (P,), ascending, positions and colours (P, 3), and by the id of an image the points it sees."""
    records = read_point_records(folder)
    ids = np.frombuffer(records.ids, np.uint64)
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    if (repeated := np.flatnonzero(ids[1:] == ids[:-1])).size:
        raise SceneError(f"{folder}: points3D: point {ids[repeated[0]]} occurs twice; export it again")
    points = np.frombuffer(records.positions, np.float64).reshape(-1, 3)[order]
    sound = (np.abs(points) < LARGEST).all(axis=1)
    if not sound.all():
        raise SceneError(f"{folder}: points3D: point {ids[np.argmin(sound)]} is not finite; remove it")
    colors = np.frombuffer(records.colors, np.uint8).reshape(-1, 3)[order]
    row_of = np.empty(len(order), np.int64)
    row_of[order] = np.arange(len(order))
    rows = np.repeat(row_of, np.frombuffer(records.track_lengths, np.uint64).astype(np.int64))
    images = np.frombuffer(records.tracks, np.uint32)[::2]
    by_image = np.lexsort((rows, images))
    rows, images = rows[by_image], images[by_image]
    names, first = np.unique(images, return_index=True)
    parts = np.split(rows, first[1:]) if len(names) else []
    observed = {int(image): np.unique(part) for image, part in zip(names, parts, strict=True)}
    return ids, points, colors, observed


def _image(
    folder: Path,
    record: ImageRecord,
    cameras: dict[int, ColmapCamera],
    ids: NDArray[np.uint64],
    observed: dict[int, NDArray[np.int64]],
) -> ColmapImage:
    """The image of a record; `ids` (P,) are those of the model's points."""
    name = record.name[:60]
    if record.camera not in cameras:
        raise SceneError(
            f"{folder}: COLMAP cannot read the model: {name} has camera {record.camera}, "
            "which is not there; export it again"
        )
    _check_pose(folder, name, record.pose)
    row = np.searchsorted(ids, record.points)
    known = (record.points != NO_POINT) & (row < len(ids))
    known[known] = ids[row[known]] == record.points[known]
    pixels = record.pixels[known]
    if not (np.abs(pixels) < LARGEST).all():
        raise SceneError(f"{folder}: images: {name}: an observation is not finite; export the model again")
    return ColmapImage(
        record.name,
        cameras[record.camera],
        _rotation(*record.pose[:4]),
        np.array(record.pose[4:]),
        observed.get(record.id, np.empty(0, np.int64)),
        row[known].astype(np.int64),
        pixels,
        np.array(record.pose[:4]),
    )


def _check_pose(folder: Path, name: str, pose: Sequence[float]) -> None:
    """`pose` is a quaternion w x y z, then a translation."""
    if not all(abs(number) < LARGEST for number in pose):
        raise SceneError(f"{folder}: the pose of {name} is not finite; remove that image or repair its pose")
    norm = math.hypot(*pose[:4])
    if abs(norm - 1) > _UNIT_TOLERANCE:
        raise SceneError(f"{folder}: the quaternion of {name} has norm {norm:.4g}, not 1; repair its pose")


def _rotation(w: float, x: float, y: float, z: float) -> NDArray[np.float64]:
    """(3, 3) of a quaternion that text has rounded: made unit first, so that the matrix is a rotation."""
    xyzw = np.array([x, y, z, w])
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
