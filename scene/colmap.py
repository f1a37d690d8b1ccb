"""COLMAP models: read without COLMAP, as files may be damaged or of a fork, and written through pycolmap."""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap_files import (
    EQUIRECTANGULAR,
    NO_POINT,
    PINHOLE,
    SIMPLE_PINHOLE,
    ColmapCamera,
    ImageRecord,
    read_cameras,
    read_frame_poses,
    read_image_records,
    read_point_records,
)
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic, natural_key

if TYPE_CHECKING:
    import pycolmap

LARGEST = 1e12  # of any coordinate: a larger one is no place, and its square must stay a number
_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: text models have as few as four digits
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


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model; images in the file's order, points by their id."""

    images: list[ColmapImage]
    points: NDArray[np.float64]  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB


def read_panoramas(folder: Path) -> ColmapModel:
    """Reads a model of panoramas from `folder` without observations; images in natural order.

    A panorama is an EQUIRECTANGULAR camera, SphereSfM's SPHERE (which projects alike), or the dummy
    `PINHOLE W H W H W/2 H/2` of Pano360.

    Raises:
        SceneError: the model is damaged, its poses are broken or its cameras are not panoramas.
        OSError: a file of it cannot be read.
    """
    for camera in read_cameras(folder).values():
        _check_panorama(folder, camera)
    model = read_colmap(folder, observations=False)
    return replace(model, images=sorted(model.images, key=lambda image: natural_key(image.name)))


def read_colmap(folder: Path, *, observations: bool = True) -> ColmapModel:
    """Reads cameras, images and points3D from `folder`, binary if it has cameras.bin, else text.

    Args:
        observations: whether to keep the observations of the images.

    Raises:
        SceneError: a file is missing or damaged; the message names it and what in it.
        OSError: a file cannot be read.
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
    images: Sequence[tuple[str, NDArray[np.float64], NDArray[np.float64]]],
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
        folder: where cameras.bin and the others go, such as SCENE/sparse/0; made if missing.
        images: (name, rotation (3, 3), translation (3,)), world-to-camera.
        width, height: pixels.
        points: (P, 3) world units.
        colors: (P, 3) RGB.
        observations: for each image the rows of the points that it sees and where, in pixels.
    """
    reconstruction = reconstruction_of(
        images, width=width, height=height, points=points, colors=colors, observations=observations
    )
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        reconstruction.write_binary(temporary)
        for file in sorted(Path(temporary).iterdir(), key=lambda file: file.name == "points3D.bin"):
            with atomic(folder / file.name) as whole:
                file.replace(whole)


def reconstruction_of(
    images: Sequence[tuple[str, NDArray[np.float64], NDArray[np.float64]]],
    *,
    width: int,
    height: int,
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
    observations: Sequence[Observations],
) -> "pycolmap.Reconstruction":
    """The model that `write_colmap` writes; images and points have ids from 1 in their order."""
    import cv2  # noqa: F401, PLC0415 (before pycolmap: see panolog.prepare)
    import pycolmap  # noqa: PLC0415 (slow and large: loaded where a model is made)

    camera = pycolmap.Camera(
        camera_id=1, model=EQUIRECTANGULAR, width=width, height=height, params=[float(width), float(height)]
    )
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for index, ((name, rotation, translation), (rows, pixels)) in enumerate(
        zip(images, observations, strict=True), start=1
    ):
        image = pycolmap.Image(
            name, np.asarray(pixels, np.float64).reshape(-1, 2), camera_id=1, image_id=index
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(rotation, np.float64)), translation)
        reconstruction.add_image_with_trivial_frame(image, pose)
        for feature, row in enumerate(rows):
            tracks[row].add_element(index, feature)
    for point, color, track in zip(points, colors, tracks, strict=True):
        reconstruction.add_point3D(point, track, color)
    return reconstruction


def _check_panorama(folder: Path, camera: ColmapCamera) -> None:
    """Refuses what is no full 2:1 panorama."""
    W, H = camera.width, camera.height
    where = f"{folder}: camera {camera.id} ({camera.model}, {W} x {H})"
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
