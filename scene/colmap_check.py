"""The bytes of a COLMAP model, checked before COLMAP reads them.

COLMAP reads past the end of a truncated binary, takes SphereSfM's SPHERE for a fisheye of the same id and
keeps a quaternion that is not unit. So the records are walked here first; only the cameras are kept.
"""

import math
import mmap
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from panolog.scene.errors import SceneError

EQUIRECTANGULAR, PINHOLE, SPHERE = "EQUIRECTANGULAR", "PINHOLE", "SPHERE"
# COLMAP's id: (name, parameters). SphereSfM gave SPHERE the id of COLMAP's RAD_TAN_THIN_PRISM_FISHEYE (16).
_MODELS = {17: (EQUIRECTANGULAR, 2), 1: (PINHOLE, 4), 11: (SPHERE, 3)}
_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: text models carry as few as four digits
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion and translation, camera
_FRAME = struct.Struct("<II7dI")  # id, rig, quaternion and translation, number of data ids
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, track length
_COUNT = struct.Struct("<Q")
_POINT2D, _TRACK, _DATA_ID = 24, 8, 16  # bytes of one entry


@dataclass(frozen=True)
class RawCamera:
    """A camera as the file has it."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


def check_model(folder: Path) -> list[RawCamera]:
    """Walks the model in `folder` (binary if it has cameras.bin, as COLMAP prefers, else text).

    Returns its cameras, whose models are EQUIRECTANGULAR, PINHOLE or SPHERE.

    Raises:
        SceneError: a file is missing or truncated, another camera model, a pose of NaN or not unit.
        OSError: a file cannot be read.
    """
    suffix = model_suffix(folder)
    for name in ("cameras", "images", "points3D"):
        if not (folder / f"{name}{suffix}").is_file():
            raise SceneError(f"{folder}: the COLMAP model has no {name}{suffix}; export it again")
    if suffix == ".txt":
        _check_images_text(folder / "images.txt")
        return list(_cameras_text(folder / "cameras.txt"))
    for name, walk in (("images", _walk_images), ("frames", _walk_frames), ("points3D", _walk_points)):
        path = folder / f"{name}.bin"
        if path.is_file():
            with _mapped(path) as data:
                walk(path, data)
    with _mapped(folder / "cameras.bin") as data:
        return list(_cameras_binary(folder / "cameras.bin", data))


def model_suffix(folder: Path) -> str:
    """'.bin' or '.txt': which of its two formats the model in `folder` has; COLMAP prefers binary."""
    return ".bin" if (folder / "cameras.bin").is_file() else ".txt"


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """The file's bytes; running past their end, in any way, is an SceneError."""
    if not path.stat().st_size:
        raise SceneError(f"{path}: the file is empty; export the COLMAP model again")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            yield data
        except (struct.error, OverflowError) as error:  # past the end, or absurdly far past it
            raise SceneError(f"{path}: truncated; export the COLMAP model again") from error


def _end(path: Path, data: mmap.mmap, at: int) -> None:
    """Checks that the last record ends where the file does."""
    if at > len(data):
        raise SceneError(f"{path}: truncated; export the COLMAP model again")
    if at < len(data):
        raise SceneError(f"{path}: {len(data) - at} bytes more than its records; no COLMAP model, or damaged")


def _cameras_binary(path: Path, data: mmap.mmap) -> Iterator[RawCamera]:
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    for _ in range(count):
        camera, model, width, height = _CAMERA.unpack_from(data, at)
        if model not in _MODELS:
            raise _unknown(path, f"id {model}")
        name, n = _MODELS[model]
        params = struct.unpack_from(f"<{n}d", data, at + _CAMERA.size)
        at += _CAMERA.size + 8 * n
        if name == SPHERE and not _is_sphere(width, height, params):
            raise _unknown(path, "RAD_TAN_THIN_PRISM_FISHEYE")
        yield RawCamera(camera, name, width, height, params)
    _end(path, data, at)


def _is_sphere(width: int, height: int, params: tuple[float, ...]) -> bool:
    """SphereSfM's three parameters are f, W/2, H/2; a fisheye's first three are fx, fy, cx."""
    return params[1:] == (width / 2, height / 2)


def _cameras_text(path: Path) -> Iterator[RawCamera]:
    for line in _lines(path):
        words = line.split()
        if len(words) < 4:
            raise SceneError(f"{path}: cannot read the camera line `{line}`")
        numbers = _floats(path, [words[0], *words[2:]])
        if not all(map(math.isfinite, numbers)):
            raise SceneError(f"{path}: a number of the camera line `{line}` is not finite")
        camera = RawCamera(int(numbers[0]), words[1], int(numbers[1]), int(numbers[2]), tuple(numbers[3:]))
        expected = dict(_MODELS.values()).get(camera.model)
        if expected is None:
            raise _unknown(path, camera.model)
        if len(camera.params) != expected:
            raise SceneError(f"{path}: {camera.model} has {expected} parameters, not {len(camera.params)}")
        yield camera


def _unknown(path: Path, model: str) -> SceneError:
    return SceneError(
        f"{path}: camera model {model} is not supported; panoramas need EQUIRECTANGULAR "
        "(or SPHERE of SphereSfM, or the dummy PINHOLE W H W H W/2 H/2)"
    )


def _walk_images(path: Path, data: mmap.mmap) -> None:
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    for _ in range(count):
        _, *pose, _ = _IMAGE.unpack_from(data, at)
        at += _IMAGE.size
        end = data.find(b"\0", at)
        if end < 0:
            raise struct.error("a name without an end")
        _check_pose(path, _name(path, data[at:end]), pose)
        (points,) = _COUNT.unpack_from(data, end + 1)
        at = end + 1 + _COUNT.size + _POINT2D * points
    _end(path, data, at)


def _name(path: Path, raw: bytes) -> str:
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: the image name {raw[:80]!r} is not UTF-8; rename it") from error


def _walk_frames(path: Path, data: mmap.mmap) -> None:
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    for _ in range(count):
        frame, _, *pose, ids = _FRAME.unpack_from(data, at)
        _check_pose(path, f"frame {frame}", pose)
        at += _FRAME.size + _DATA_ID * ids
    _end(path, data, at)


def _walk_points(path: Path, data: mmap.mmap) -> None:
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    for _ in range(count):
        track = _POINT.unpack_from(data, at)[-1]
        at += _POINT.size + _TRACK * track
    _end(path, data, at)


def _check_images_text(path: Path) -> None:
    """Every image has two lines: its pose, then its points, which may be empty."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) < 10:
                raise SceneError(f"{path}: cannot read the image line `{line.strip()[:80]}`")
            _check_pose(path, words[9], _floats(path, words[1:8]))
            if len(next(file, "").split()) % 3:
                raise SceneError(f"{path}: the points of {words[9]} are no triples; the file is truncated")


def _check_pose(path: Path, name: str, pose: list[float]) -> None:
    """`pose` is a quaternion w x y z, then a translation."""
    if not all(map(math.isfinite, pose)):
        raise SceneError(f"{path}: the pose of {name} is not finite; remove that image or repair its pose")
    norm = math.hypot(*pose[:4])
    if abs(norm - 1) > _UNIT_TOLERANCE:
        raise SceneError(f"{path}: the quaternion of {name} has norm {norm:.4g}, not 1; repair its pose")


def _floats(path: Path, words: Iterable[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise SceneError(f"{path}: a number was expected: {error}") from error


def _lines(path: Path) -> Iterator[str]:
    """The lines that are neither empty nor comments."""
    with path.open(encoding="utf-8", errors="replace") as file:
        yield from (line.strip() for line in file if line.strip() and not line.startswith("#"))
