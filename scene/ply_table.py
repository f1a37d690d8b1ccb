"""The table in a binary PLY: its header, checked, and its rows as numpy records."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import PlyError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_LINE = 4096  # bytes; a header line is shorter, so what is longer is no header


@dataclass(frozen=True)
class Table:
    """Where the rows of the first element are and what each one holds."""

    path: Path
    count: int  # rows
    dtype: np.dtype[Any]  # one row
    offset: int  # bytes before the first row
    comments: tuple[str, ...]

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows start to stop (exclusive) as records of `dtype`.

        Raises:
            PlyError: the file has become shorter since its header was read.
        """
        records = np.fromfile(
            self.path, self.dtype, stop - start, offset=self.offset + start * self.dtype.itemsize
        )
        if len(records) != stop - start:
            raise PlyError(f"{self.path}: truncated while it was read; copy it again")
        return records


def read_table(path: Path) -> Table:
    """Reads the header of a binary PLY and checks that all rows of its first element, `vertex`, are there.

    Raises:
        PlyError: no such file, no PLY, ASCII, another first element, a list property, or truncated.
    """
    if not path.is_file():
        raise PlyError(f"{path}: there is no such file")
    with path.open("rb") as file:
        lines = _header_lines(path, file)
        offset = file.tell()
    order, count, properties = _parse(path, lines)
    table = Table(
        path,
        count,
        np.dtype([(name, order + kind) for name, kind in properties]),
        offset,
        tuple(line.partition(" ")[2] for line in lines if line.startswith("comment ")),
    )
    missing = offset + count * table.dtype.itemsize - path.stat().st_size
    if missing > 0:
        raise PlyError(f"{path}: truncated, {missing} bytes of its {count} rows are missing; copy it again")
    return table


def sky_of(table: Table) -> int:
    """How many rows at the end are sky Gaussians, as the comment `panolog sky N` says; 0 without one.

    Raises:
        PlyError: more than there are rows.
    """
    found = [re.fullmatch(r"panolog sky (\d+)", comment) for comment in table.comments]
    sky = next((int(match[1]) for match in found if match), 0)
    if sky > table.count:
        raise PlyError(
            f"{table.path}: the header promises {sky} sky Gaussians of {table.count}; it is damaged"
        )
    return sky


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    """The lines between `ply` and `end_header`."""
    if file.readline(_LONGEST_LINE).strip() != b"ply":
        raise PlyError(f"{path}: not a PLY file (it does not begin with `ply`)")
    lines: list[str] = []
    while True:
        line = file.readline(_LONGEST_LINE)
        if not line.endswith(b"\n"):
            raise PlyError(f"{path}: the PLY header has no end; the file is truncated or damaged")
        text = line.decode("utf-8", "replace").strip()
        if text == "end_header":
            return lines
        lines.append(text)


def _parse(path: Path, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """(byte order, rows, properties as (name, numpy kind)) of the first element."""
    words = [line.split() for line in lines if line and not line.startswith(("comment", "obj_info"))]
    layout = next((line[1] for line in words if line[0] == "format" and len(line) > 1), "")
    if layout not in _ORDER:
        raise PlyError(f"{path}: PLY format {layout or 'unknown'} cannot be read; save it as binary PLY")
    elements = [index for index, line in enumerate(words) if line[0] == "element"]
    if not elements or words[elements[0]][1:2] != ["vertex"] or not words[elements[0]][-1].isdigit():
        raise PlyError(f"{path}: the first element of the PLY is not `vertex`; save it uncompressed")
    stop = elements[1] if len(elements) > 1 else len(words)
    properties = [line for line in words[elements[0] : stop] if line[0] == "property"]
    for line in properties:
        if len(line) != 3 or line[1] not in _TYPES:
            raise PlyError(f"{path}: the PLY has a vertex property that is no number: {' '.join(line)}")
    names = [name for _, _, name in properties]
    if len(set(names)) != len(names) or not names:
        raise PlyError(f"{path}: the vertex properties of the PLY are missing or named twice")
    return _ORDER[layout], int(words[elements[0]][-1]), [(name, _TYPES[kind]) for _, kind, name in properties]
