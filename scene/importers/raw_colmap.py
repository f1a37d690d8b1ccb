"""COLMAP models, binary or text, with their observations; also with cameras that COLMAP does not know.

Read without COLMAP, because the files may be damaged or of a fork: every count is checked against the bytes
that are there before anything is made of it. Poses are those of the images, which COLMAP also writes when it
has rigs. Layout: COLMAP's src/colmap/scene/reconstruction_io_binary.cc and doc/format.rst.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.scene.colmap_check import EQUIRECTANGULAR, PINHOLE, SPHERE, RawCamera, model_suffix
from panolog.scene.errors import InputError
from panolog.scene.importers.axes import LARGEST, Array

SIMPLE_PINHOLE = "SIMPLE_PINHOLE"
_MODELS = {0: (SIMPLE_PINHOLE, 3), 1: (PINHOLE, 4), 11: (SPHERE, 3), 17: (EQUIRECTANGULAR, 2)}
_PARAMETERS = dict(_MODELS.values())
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_NO_POINT = 2**64 - 1
_LONGEST_NAME = 1024  # bytes


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


def read_cameras(folder: Path) -> dict[int, RawCamera]:
    """The cameras by id.

    Raises:
        InputError: damaged, or of a model that is neither a panorama nor a pinhole.
    """
    suffix = model_suffix(folder)
    path = folder / f"cameras{suffix}"
    cameras = _cameras_binary(path) if suffix == ".bin" else _cameras_text(path)
    return {camera.id: camera for camera in cameras}


def read_raw(folder: Path) -> RawModel:
    """Reads cameras, images and points3D from `folder`.

    Raises:
        InputError: a file is missing or damaged; the message names it and what in it.
        OSError: a file cannot be read.
    """
    cameras = read_cameras(folder)
    binary = model_suffix(folder) == ".bin"
    points = _points_binary(folder / "points3D.bin") if binary else _points_text(folder / "points3D.txt")
    ids, where, colors = _by_id(folder, points)
    path = folder / ("images.bin" if binary else "images.txt")
    entries = _images_binary(path) if binary else _images_text(path)
    images = []
    for name, camera, pose, pixels, seen in entries:
        if camera not in cameras:
            raise InputError(f"{path}: {name}: there is no camera {camera}; export the model again")
        matrix, translation = _pose(path, name, pose)
        row = np.searchsorted(ids, seen)
        known = (seen != _NO_POINT) & (row < len(ids))
        known[known] = ids[row[known]] == seen[known]
        if not (np.abs(pixels[known]) < LARGEST).all():
            raise InputError(f"{path}: {name}: an observation is not finite; export the model again")
        rows = row[known].astype(np.int64)
        images.append(RawImage(name, cameras[camera], matrix, translation, pixels[known], rows))
    return RawModel(images, where, colors)


Entry = tuple[str, int, tuple[float, ...], Array, NDArray[np.uint64]]  # name, camera, pose, (M, 2), (M,) ids


class _Cursor:
    """Reads records from bytes; running past their end is an InputError."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path}: the COLMAP model has no such file; export it again")
        self.path, self.data, self.at = path, memoryview(path.read_bytes()), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        return struct.unpack_from(layout, self.data, self.advance(size))

    def advance(self, size: int) -> int:
        """Steps over `size` bytes and returns where they begin."""
        at = self.at
        if size > len(self.data) - at:
            raise InputError(
                f"{self.path}: truncated at byte {len(self.data)}; export the COLMAP model again"
            )
        self.at = at + size
        return at

    def count(self, smallest: int) -> int:
        """The number of records that follow, of at least `smallest` bytes each."""
        (count,) = self.take("<Q")
        if count * smallest > len(self.data) - self.at:
            raise InputError(
                f"{self.path}: promises {count:,} records, for which it is too short; export it again"
            )
        return int(count)

    def text(self) -> str:
        end = bytes(self.data[self.at : self.at + _LONGEST_NAME]).find(b"\0")
        if end < 0:
            raise InputError(
                f"{self.path}: an image name at byte {self.at} has no end; export the model again"
            )
        raw = bytes(self.data[self.at : self.at + end])
        self.at += end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: the image name {raw[:60]!r} is not UTF-8") from error


def _camera(
    path: Path, number: int, model: str, size: tuple[int, int], params: tuple[float, ...]
) -> RawCamera:
    """A camera, checked: a finite one of a known model, and a panorama 2:1 and centred."""
    width, height = size
    where = f"{path}: camera {number} ({model}, {width} x {height})"
    if not (0 < width < 2**20 and 0 < height < 2**20 and all(map(math.isfinite, params))):
        raise InputError(f"{where} has a size or parameter that cannot be; export the model again")
    if model in (SPHERE, EQUIRECTANGULAR) and width != 2 * height:
        raise InputError(f"{where} is not 2:1, so it is no full panorama")
    if model == SPHERE and params[1:] != (width / 2, height / 2):
        raise InputError(f"{where} is no SPHERE of SphereSfM: its centre is not the middle of the image")
    if model in (PINHOLE, SIMPLE_PINHOLE) and not params[0] > 0:
        raise InputError(f"{where} has no positive focal length; export the model again")
    return RawCamera(number, model, width, height, params)


def _cameras_binary(path: Path) -> Iterator[RawCamera]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(40)):
        number, model, width, height = cursor.take("<IiQQ")
        if model not in _MODELS:
            raise InputError(f"{path}: camera {number}: model id {model} is neither a panorama nor a pinhole")
        name, parameters = _MODELS[model]
        yield _camera(path, number, name, (width, height), cursor.take(f"<{parameters}d"))


def _cameras_text(path: Path) -> Iterator[RawCamera]:
    for number, line in _lines(path):
        words = line.split()
        if not line or line.startswith("#"):
            continue
        numbers = _numbers(path, number, [words[0], *words[2:]], 3)
        if len(words) < 2 or _PARAMETERS.get(words[1]) != len(numbers) - 3:
            raise InputError(f"{path}: line {number}: `{line[:60]}` is neither a panorama nor a pinhole")
        size = (int(numbers[1]), int(numbers[2]))
        yield _camera(path, int(numbers[0]), words[1], size, tuple(numbers[3:]))


def _images_binary(path: Path) -> Iterator[Entry]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(73)):
        _, *pose, camera = cursor.take("<I7dI")
        name = cursor.text()
        count = cursor.count(_POINT2D.itemsize)
        seen = np.frombuffer(cursor.data, _POINT2D, count, cursor.advance(count * _POINT2D.itemsize))
        yield name, camera, tuple(pose), seen["xy"].astype(np.float64), seen["point"].astype(np.uint64)


def _images_text(path: Path) -> Iterator[Entry]:
    """Every image has two lines: its pose, then its points, which may be empty."""
    lines = _lines(path)
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 9)
        if len(words) < 10:
            raise InputError(f"{path}: line {number}: `{line[:60]}` is no image; export the model again")
        pose = _numbers(path, number, words[1:8], 7)
        camera = _numbers(path, number, words[8:9], 1)
        below, second = next(lines, (number, ""))
        values = np.array(_numbers(path, below, second.split(), 0))
        if len(values) % 3:
            raise InputError(f"{path}: line {below}: the points of {words[9][:60]} are no triples")
        seen = values.reshape(-1, 3)
        ids = np.where((seen[:, 2] >= 0) & (seen[:, 2] < 2**53), seen[:, 2], 2**53).astype(np.uint64)
        ids[ids == 2**53] = _NO_POINT
        yield words[9], int(camera[0]), tuple(pose), seen[:, :2], ids


def _points_binary(path: Path) -> Iterator[tuple[int, Array, tuple[int, ...]]]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(51)):
        number, x, y, z, red, green, blue, _, track = cursor.take("<Q3d3BdQ")
        cursor.advance(8 * track)
        yield number, np.array((x, y, z)), (red, green, blue)


def _points_text(path: Path) -> Iterator[tuple[int, Array, tuple[int, ...]]]:
    for number, line in _lines(path):
        if not line or line.startswith("#"):
            continue
        values = _numbers(path, number, line.split(None, 8)[:7], 7)
        if not all(0 <= value < 256 for value in values[4:]) or not 0 <= values[0] < 2**53:
            raise InputError(f"{path}: line {number}: `{line[:60]}` is no point; export the model again")
        yield int(values[0]), np.array(values[1:4]), tuple(int(value) for value in values[4:])


def _by_id(
    folder: Path, points: Iterator[tuple[int, Array, tuple[int, ...]]]
) -> tuple[NDArray[np.uint64], Array, NDArray[np.uint8]]:
    """Ids (P,), ascending, places (P, 3) and colours (P, 3)."""
    entries = sorted(points, key=lambda point: point[0])
    ids = np.array([entry[0] for entry in entries], np.uint64)
    where = np.array([entry[1] for entry in entries], np.float64).reshape(-1, 3)
    sound = (np.abs(where) < LARGEST).all(axis=1)
    if not sound.all():
        bad = ids[int(np.argmin(sound))]
        raise InputError(f"{folder}: points3D: point {bad} is not finite; remove it")
    return ids, where, np.array([entry[2] for entry in entries], np.uint8).reshape(-1, 3)


def _pose(path: Path, name: str, pose: tuple[float, ...]) -> tuple[Array, Array]:
    w, x, y, z, *translation = pose
    if not all(abs(number) < LARGEST for number in pose) or abs(math.hypot(w, x, y, z) - 1) > 1e-3:
        raise InputError(
            f"{path}: the pose of {name[:60]} is not finite, or its quaternion is not unit; repair it"
        )
    return Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(translation)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, line) of a text file, without line ends."""
    if not path.is_file():
        raise InputError(f"{path}: the COLMAP model has no such file; export it again")
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            yield number, line.strip()


def _numbers(path: Path, line: int, words: list[str], least: int) -> list[float]:
    """Finite numbers, at least `least` of them."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) < least or not all(map(math.isfinite, numbers)):
        raise InputError(f"{path}: line {line}: finite numbers were expected; export the model again")
    return numbers
