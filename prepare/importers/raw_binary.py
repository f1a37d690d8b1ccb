"""The binary form of a COLMAP model; nothing is made of a count that the file has no bytes for.

Layout: COLMAP's src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from panolog.prepare.importers.raw_records import MODELS, Entry, Points, camera
from panolog.scene.colmap_check import RawCamera
from panolog.scene.errors import SceneError

_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_LONGEST_NAME = 1024  # bytes


class _Cursor:
    """Reads records from bytes; running past their end is an SceneError."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise SceneError(f"{path}: the COLMAP model has no such file; export it again")
        self.path, self.data, self.at = path, memoryview(path.read_bytes()), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        return struct.unpack_from(layout, self.data, self.advance(size))

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
        (count,) = self.take("<Q")
        if count * smallest > len(self.data) - self.at:
            raise SceneError(
                f"{self.path}: promises {count:,} records, for which it is too short; export it again"
            )
        return int(count)

    def text(self) -> str:
        end = bytes(self.data[self.at : self.at + _LONGEST_NAME]).find(b"\0")
        if end < 0:
            raise SceneError(
                f"{self.path}: an image name at byte {self.at} has no end; export the model again"
            )
        raw = bytes(self.data[self.at : self.at + end])
        self.at += end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise SceneError(f"{self.path}: the image name {raw[:60]!r} is not UTF-8") from error


def cameras(path: Path) -> Iterator[RawCamera]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(40)):
        number, model, width, height = cursor.take("<IiQQ")
        if model not in MODELS:
            raise SceneError(f"{path}: camera {number}: model id {model} is neither a panorama nor a pinhole")
        name, parameters = MODELS[model]
        yield camera(path, number, name, (width, height), cursor.take(f"<{parameters}d"))


def images(path: Path) -> Iterator[Entry]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(73)):
        _, *pose, owner = cursor.take("<I7dI")
        name = cursor.text()
        count = cursor.count(_POINT2D.itemsize)
        seen = np.frombuffer(cursor.data, _POINT2D, count, cursor.advance(count * _POINT2D.itemsize))
        yield name, owner, tuple(pose), seen["xy"].astype(np.float64), seen["point"].astype(np.uint64)


def points(path: Path) -> Points:
    cursor, found = _Cursor(path), Points()
    for _ in range(cursor.count(51)):
        number, x, y, z, *color, _, track = cursor.take("<Q3d3BdQ")
        cursor.advance(8 * track)
        found.add(number, (x, y, z), color)
    return found
