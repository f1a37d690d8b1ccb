"""The records in the files of a COLMAP model, binary and text.

Files may be damaged or hostile: every count is compared with the bytes that are left before anything is made
of it. Layout: COLMAP's src/colmap/scene/reconstruction_io_binary.cc and doc/format.rst.
"""

import math
import mmap
import struct
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError

EQUIRECTANGULAR, PINHOLE, SIMPLE_PINHOLE, SPHERE = "EQUIRECTANGULAR", "PINHOLE", "SIMPLE_PINHOLE", "SPHERE"
EQUIRECTANGULAR_ID = 17  # COLMAP's
# COLMAP's id: (name, parameters). SphereSfM gave SPHERE the id of COLMAP's RAD_TAN_THIN_PRISM_FISHEYE.
_MODELS = {0: (SIMPLE_PINHOLE, 3), 1: (PINHOLE, 4), 11: (SPHERE, 3), EQUIRECTANGULAR_ID: (EQUIRECTANGULAR, 2)}
_PARAMETERS = dict(_MODELS.values())
# COLMAP's id: name and parameters of what is no panorama, and may be in a model if no image has it.
_OTHERS = {
    **{2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8), 5: ("OPENCV_FISHEYE", 8)},
    **{6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5)},
    **{10: ("THIN_PRISM_FISHEYE", 12), 12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5)},
    **{14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6)},
}
_SPHERICAL = (EQUIRECTANGULAR, "SPHERICAL")  # what others write into text models, also without its size again
NO_POINT = 2**64 - 1  # the id of an observation that belongs to no point
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
IMAGE = struct.Struct("<I7dI")  # id, quaternion and translation, camera
FRAME = struct.Struct("<II7dI")  # id, rig, quaternion and translation, number of data ids
POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, track length
COUNT = struct.Struct("<Q")
POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_TRACK, _DATA_ID = 8, 16  # bytes of one entry
_LONGEST_NAME = 1024  # bytes
_LONGEST_LINE = 2**24  # characters: half a million observations of one image; 0.8 GB while it is parsed
_LONGEST_TEXT = 2**27  # bytes of a text file
_LARGEST_SIZE = 2**20  # pixels


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of a model; COLMAP itself does not know SphereSfM's SPHERE."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One entry of images.bin or images.txt."""

    id: int
    name: str
    camera: int
    pose: Sequence[float]  # quaternion w x y z and translation, world-to-camera
    pixels: NDArray[np.float64]  # (M, 2) of the observations
    points: NDArray[np.uint64]  # (M,) ids of their points, NO_POINT where there is none


class PointRecords:
    """The entries of points3D.bin or points3D.txt in the file's order, without an object for each."""

    def __init__(self) -> None:
        self.ids = array("Q")
        self.positions = array("d")  # three each
        self.colors = bytearray()  # three each
        self.track_lengths = array("Q")
        self.tracks = bytearray()  # uint32, two for each entry: the image's id, the observation's number

    def add(self, number: int, position: Iterable[float], color: Iterable[int], track: bytes) -> None:
        self.ids.append(number)
        self.positions.extend(position)
        self.colors.extend(color)
        self.track_lengths.append(len(track) // _TRACK)
        self.tracks += track


def read_cameras(folder: Path) -> dict[int, ColmapCamera]:
    """The cameras of the model in `folder` by id.

    Raises SceneError: the file is missing or damaged, or has a camera of a model that COLMAP did not know.
    """
    path = _file(folder, "cameras")
    cameras = _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)
    return {camera.id: camera for camera in cameras}


def read_image_records(folder: Path, *, observations: bool) -> Iterator[ImageRecord]:
    """The images; without `observations` these are checked but not kept. Raises SceneError if damaged."""
    path = _file(folder, "images")
    return _binary_images(path, observations) if path.suffix == ".bin" else _text_images(path, observations)


def read_point_records(folder: Path) -> PointRecords:
    """The points with their tracks. Raises SceneError if the file is damaged."""
    path = _file(folder, "points3D")
    return _binary_points(path) if path.suffix == ".bin" else _text_points(path)


def read_frame_poses(folder: Path) -> Iterator[tuple[int, Sequence[float]]]:
    """Id and pose of each frame in frames.bin, nothing without that file. Raises SceneError if damaged."""
    path = folder / "frames.bin"
    if path.is_file():
        cursor = _Cursor(path)
        for _ in range(cursor.count(FRAME.size)):
            number, _, *pose, ids = cursor.take(FRAME)
            cursor.advance(_DATA_ID * ids)
            yield number, pose
        cursor.end()


def _file(folder: Path, stem: str) -> Path:
    """A file of the model; COLMAP prefers its binary format."""
    path = folder / f"{stem}{'.bin' if (folder / 'cameras.bin').is_file() else '.txt'}"
    if not path.is_file():
        raise SceneError(f"{folder}: the COLMAP model has no {path.name}; export it again")
    return path


def _camera(
    where: str, number: int, model: str, size: tuple[int, int], params: tuple[float, ...]
) -> ColmapCamera:
    """A camera, checked: a finite one, and a SPHERE 2:1 and centred, as others have its id."""
    width, height = size
    where = f"{where}: camera {number} ({model}, {width} x {height})"
    if not (0 < width < _LARGEST_SIZE and 0 < height < _LARGEST_SIZE and all(map(math.isfinite, params))):
        raise SceneError(f"{where} has an impossible size or parameter; export the model again")
    if model == SPHERE and width != 2 * height:
        raise SceneError(f"{where} is not 2:1, so it is not a full panorama")
    if model == SPHERE and params[1:] != (width / 2, height / 2):
        raise SceneError(
            f"{where} has its centre off the middle of the image, so it is not a SPHERE of SphereSfM; "
            "RAD_TAN_THIN_PRISM_FISHEYE, which has the same id, is not supported"
        )
    if model in (PINHOLE, SIMPLE_PINHOLE) and not params[0] > 0:
        raise SceneError(f"{where} has no positive focal length; export the model again")
    return ColmapCamera(number, model, width, height, params)


class _Cursor:
    """Reads records from a binary file; running past its end is a SceneError."""

    def __init__(self, path: Path) -> None:
        if not path.stat().st_size:
            raise SceneError(f"{path}: the file is empty; export the COLMAP model again")
        with path.open("rb") as file:
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.path, self.at = path, 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        return layout.unpack_from(self.data, self.advance(layout.size))

    def advance(self, size: int) -> int:
        """Steps over `size` bytes and returns where they begin."""
        at = self.at
        if size > len(self.data) - at:
            raise SceneError(
                f"{self.path}: truncated at byte {len(self.data)}; export the COLMAP model again"
            )
        self.at = at + size
        return at

    def count(self, smallest: int) -> int:
        """The number of records that follow, of at least `smallest` bytes each."""
        (count,) = self.take(COUNT)
        if count * smallest > len(self.data) - self.at:
            raise SceneError(
                f"{self.path}: truncated: it is too short for its {count:,} records; export it again"
            )
        return int(count)

    def text(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise SceneError(
                f"{self.path}: truncated in an image name at byte {self.at}; export the model again"
            )
        raw = self.data[self.at : end]
        self.at = end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.path}: the image name {raw[:60]!r} is not UTF-8; rename it") from error

    def end(self) -> None:
        """Checks that the last record ends where the file does."""
        if extra := len(self.data) - self.at:
            raise SceneError(f"{self.path}: {extra} bytes more than its records; no COLMAP model, or damaged")


def _binary_cameras(path: Path) -> Iterator[ColmapCamera]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(CAMERA.size)):
        number, model, width, height = cursor.take(CAMERA)
        known = _MODELS.get(model) or _OTHERS.get(model)
        if known is None:
            raise unknown_camera(f"{path}: camera {number}", f"id {model}")
        name, parameters = known
        params = cursor.take(struct.Struct(f"<{parameters}d"))
        yield _camera(str(path), number, name, (width, height), params)
    cursor.end()


def _binary_images(path: Path, observations: bool) -> Iterator[ImageRecord]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(IMAGE.size + 1 + COUNT.size)):
        number, *pose, camera = cursor.take(IMAGE)
        name = cursor.text()
        count = cursor.count(POINT2D.itemsize)
        at = cursor.advance(count * POINT2D.itemsize)
        seen = np.frombuffer(cursor.data, POINT2D, count if observations else 0, at)
        yield ImageRecord(
            number, name, camera, pose, seen["xy"].astype(float), seen["point"].astype(np.uint64)
        )
    cursor.end()


def _binary_points(path: Path) -> PointRecords:
    cursor, found = _Cursor(path), PointRecords()
    for _ in range(cursor.count(POINT.size)):
        number, x, y, z, *color, _, length = cursor.take(POINT)
        at = cursor.advance(_TRACK * length)
        found.add(number, (x, y, z), color, cursor.data[at : cursor.at])
    cursor.end()
    return found


def _text_cameras(path: Path) -> Iterator[ColmapCamera]:
    for where, line in _records(_lines(path)):
        words = line.split()
        if len(words) < 4:
            raise SceneError(f"{where}: cannot read the camera line `{line[:60]}`; export the model again")
        number, width, height, *params = _numbers(where, [words[0], *words[2:]])
        if words[1] in _SPHERICAL and params in ([], [width, height]):
            words[1], params = EQUIRECTANGULAR, [width, height]
        if len(params) != _PARAMETERS.get(words[1], len(params)):
            raise SceneError(f"{where}: {words[1]} has {_PARAMETERS[words[1]]} parameters, not {len(params)}")
        yield _camera(where, int(number), words[1][:40], (int(width), int(height)), tuple(params))


def _text_images(path: Path, observations: bool) -> Iterator[ImageRecord]:
    for where, line, below, second in _image_lines(path):
        words = line.split(None, 9)
        if len(words) < 10:
            raise SceneError(f"{where}: cannot read the image line `{line[:60]}`; export the model again")
        pose = _numbers(where, words[1:8])
        number, camera = _numbers(where, [words[0], words[8]])
        if "\ufffd" in words[9]:
            shown = words[9][:60].encode("ascii", "replace").decode()
            raise SceneError(f"{where}: the image name `{shown}` is not UTF-8; rename it")
        entries = second.split()
        if len(entries) % 3:
            raise SceneError(f"{below}: the points of {words[9][:60]} are not triples; the file is truncated")
        values = np.array(_numbers(below, entries) if observations else []).reshape(-1, 3)
        no_point = ~((values[:, 2] >= 0) & (values[:, 2] < 2**53))
        ids = np.where(no_point, 0, values[:, 2]).astype(np.uint64)
        ids[no_point] = NO_POINT
        yield ImageRecord(int(number), words[9], int(camera), pose, values[:, :2], ids)


def _image_lines(path: Path) -> Iterator[tuple[str, str, str, str]]:
    """Where and what the lines of each image are: its pose, then its points, which may be empty.

    Some programs write no line for the points; they are empty then.
    """
    lines = _lines(path)
    pose = next(_records(lines), None)
    while pose is not None:
        below = next(lines, (pose[0], ""))
        if _is_image(below[1]):
            yield *pose, below[0], ""
            pose = below
        else:
            yield *pose, *below
            pose = next(_records(lines), None)


def _is_image(line: str) -> bool:
    """Whether a line is of an image, which has a name, and not of points, which are triples of numbers."""
    words = line.split()
    return len(words) > 9 and (not _is_number(words[9]) or len(words) == 10)


def _is_number(word: str) -> bool:
    with suppress(ValueError):
        float(word)
        return True
    return False


def _text_points(path: Path) -> PointRecords:
    found, colors = PointRecords(), array("f")
    for where, line in _records(_lines(path)):
        words = line.split()
        number, *position, red, green, blue = _numbers(where, words[:7]) if len(words) > 6 else [-1.0] * 4
        color = (red, green, blue)
        if not all(0 <= value < 256 for value in color) or not 0 <= number < 2**53:
            raise SceneError(f"{where}: `{line[:60]}` is not a point; export the model again")
        try:
            track = array("I", map(int, words[8:]))
        except (ValueError, OverflowError) as error:
            raise SceneError(f"{where}: the track of point {int(number)} is damaged") from error
        if len(track) % 2:
            raise SceneError(f"{where}: the track of point {int(number)} is truncated")
        colors.extend(color)
        found.add(int(number), position, (), track.tobytes())
    found.colors = _bytes_of(np.asarray(colors))
    return found


def _bytes_of(colors: NDArray[np.float32]) -> bytearray:
    """Colours of a text model as bytes; some programs write them from 0 to 1."""
    fractions = len(colors) and colors.max() <= 1 and (colors % 1).any()
    return bytearray((np.rint(255 * colors) if fractions else colors).astype(np.uint8).tobytes())


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """("PATH: line N", line without its end) of a text file."""
    if path.stat().st_size > _LONGEST_TEXT:
        raise SceneError(f"{path}: too large to be read safely as text; convert the model to binary")
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), start=1):
            if len(line) == _LONGEST_LINE:
                raise SceneError(f"{path}: line {number} is not terminated; export the model again")
            yield f"{path}: line {number}", line.strip()


def _records(lines: Iterator[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """The lines that are neither empty nor comments."""
    return ((where, line) for where, line in lines if line and not line.startswith("#"))


def _numbers(where: str, words: Sequence[str]) -> list[float]:
    """Finite numbers."""
    try:
        numbers = list(map(float, words))
    except ValueError as error:
        text = "".join(words)
        how = ", with points in numbers" if "," in text else ", as UTF-8" if "\0" in text else ""
        raise SceneError(f"{where}: a number was expected; export the model again{how}") from error
    if not all(map(math.isfinite, numbers)):
        raise SceneError(f"{where}: a number is not finite; export the model again")
    return numbers


def unknown_camera(where: str, model: str) -> SceneError:
    """What to raise for a camera that is needed and of another model."""
    return SceneError(
        f"{where} is neither a panorama nor a pinhole: camera model {model} is not supported; panoramas need "
        "EQUIRECTANGULAR (or SPHERE of SphereSfM, or the dummy PINHOLE W H W H W/2 H/2)"
    )
