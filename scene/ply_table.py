"""The table in a PLY: its header, checked, and the rows of a binary one as numpy records."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import PlyError
from panolog.scene.model import NO_OFFSET, Vector

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}
EXPORTED = "panolog frame export"  # the comment of a model that was turned for viewers
_LONGEST_LINE = 4096  # bytes of a header's line
_MOST_LINES = 1000  # of a header


@dataclass(frozen=True)
class Table:
    """Where the rows of the first element are and what each one holds."""

    path: Path
    layout: str  # ascii, binary_little_endian or binary_big_endian
    count: int  # rows
    dtype: np.dtype[Any]  # one row
    offset: int  # bytes before the first row
    comments: tuple[str, ...]

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows start to stop (exclusive) as records of `dtype`.

        Raises PlyError: the file has become shorter since its header was read.
        """
        records = np.fromfile(
            self.path, self.dtype, stop - start, offset=self.offset + start * self.dtype.itemsize
        )
        if len(records) != stop - start:
            raise PlyError(f"{self.path}: truncated while it was read; copy it again")
        return records


def read_header(path: Path, file: BinaryIO) -> Table:
    """The table by the header of a PLY, whose rows may be text or missing; `file` is then at the first row.

    Raises PlyError: no PLY, another first element than `vertex`, or a list property.
    """
    lines = _header_lines(path, file)
    words = [line.split() for line in lines if line and not line.startswith(("comment", "obj_info"))]
    layout = next((line[1] for line in words if line[0] == "format" and len(line) > 1), "unknown")
    elements = [index for index, line in enumerate(words) if line[0] == "element"]
    if not elements or words[elements[0]][1:2] != ["vertex"] or not words[elements[0]][-1].isdecimal():
        raise PlyError(f"{path}: the first element of the PLY is not `vertex`; save it uncompressed")
    stop = elements[1] if len(elements) > 1 else len(words)
    properties = [line for line in words[elements[0] : stop] if line[0] == "property"]
    for line in properties:
        if len(line) != 3 or line[1] not in _TYPES:
            raise PlyError(f"{path}: the PLY has a vertex property that is not a number: {' '.join(line)}")
    names = [name for _, _, name in properties]
    if len(set(names)) != len(names) or not names:
        raise PlyError(f"{path}: the vertex properties of the PLY are missing or named twice")
    dtype = np.dtype([(name, _ORDER.get(layout, "=") + _TYPES[kind]) for _, kind, name in properties])
    comments = tuple(line.partition(" ")[2] for line in lines if line.startswith("comment "))
    return Table(path, layout, int(words[elements[0]][-1]), dtype, file.tell(), comments)


def read_table(path: Path) -> Table:
    """Reads the header of a binary PLY and checks that all rows of its first element, `vertex`, are there.

    Raises PlyError: no such file, no PLY, ASCII, another first element, a list property, or truncated.
    """
    if not path.is_file():
        raise PlyError(f"{path}: there is no such file")
    with path.open("rb") as file:
        table = read_header(path, file)
    if table.layout not in _ORDER:
        raise PlyError(f"{path}: PLY format {table.layout} cannot be read; save it as binary PLY")
    missing = table.offset + table.count * table.dtype.itemsize - path.stat().st_size
    if missing > 0:
        raise PlyError(
            f"{path}: truncated, {missing} bytes of its {table.count} rows are missing; copy it again"
        )
    return table


def read_vertices(table: Table) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    """Positions (P, 3) and colours (P, 3) of a point cloud, None where it has none.

    Raises PlyError: no position, or colours that are not 8 bit.
    """
    position, color = point_columns(table)
    if any(table.dtype[name] != np.uint8 for name in color):
        raise PlyError(f"{table.path}: the colours of the point cloud are not 8 bit; save them as uchar")
    rows = table.rows(0, table.count)
    points = np.stack([rows[name].astype(np.float64) for name in position], axis=1)
    return points, np.stack([rows[name] for name in color], axis=1) if color else None


def point_columns(table: Table) -> tuple[list[str], list[str]]:
    """The names of a point cloud's columns: x y z, and red green blue or diffuse_red and so on, or none.

    Raises PlyError: x, y or z is missing.
    """
    names = table.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names]:
        raise PlyError(f"{table.path}: the point cloud has no column {missing[0]}")
    for prefix in ("", "diffuse_"):
        color = [prefix + name for name in ("red", "green", "blue")]
        if set(color) <= set(names):
            return list("xyz"), color
    return list("xyz"), []


def sky_of(table: Table) -> int:
    """How many rows at the end are sky Gaussians, from the comment `panolog sky N`; 0 without one.

    Raises PlyError: more than there are rows.
    """
    found = [re.fullmatch(r"panolog sky (\d+)", comment) for comment in table.comments]
    sky = next((int(match[1]) for match in found if match), 0)
    if sky > table.count:
        raise PlyError(
            f"{table.path}: the header declares {sky} sky Gaussians of {table.count}; it is damaged"
        )
    return sky


def exact_of(table: Table) -> bool:
    """Whether they are seen along the rays of pixels, from the comment `panolog projection exact`."""
    return "panolog projection exact" in table.comments


def offset_of(table: Table) -> Vector:
    """What is to be added to its positions, from the comment `panolog offset X Y Z`; nothing without one.

    Raises PlyError: they are no three numbers.
    """
    found = next((it.split()[2:] for it in table.comments if it.startswith("panolog offset ")), None)
    if found is None:
        return NO_OFFSET
    try:
        x, y, z = map(float, found)
    except ValueError as error:
        raise PlyError(f"{table.path}: its comment `panolog offset` needs three numbers") from error
    if not all(map(math.isfinite, (x, y, z))):
        raise PlyError(f"{table.path}: its comment `panolog offset` is not finite")
    return x, y, z


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    """The lines between `ply` and `end_header`."""
    if file.readline(_LONGEST_LINE).strip() != b"ply":
        raise PlyError(f"{path}: not a PLY file (it does not begin with `ply`)")
    lines: list[str] = []
    while len(lines) < _MOST_LINES:
        line = file.readline(_LONGEST_LINE)
        if not line.endswith(b"\n"):
            break
        text = line.decode("utf-8", "replace").strip()
        if text == "end_header":
            return lines
        lines.append(text)
    raise PlyError(f"{path}: the PLY header is not terminated; the file is truncated or damaged")
