"""Point clouds beside poses: PLY, binary or ASCII, with colours or without."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import LARGEST
from panolog.scene.errors import PlyError
from panolog.scene.ply_table import read_table

MOST_POINTS = 10_000_000  # 0.8 GB while an ASCII file is read; a sparse cloud has some hundred thousand
_LONGEST_LINE = 4096  # bytes
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")
PointCloud = tuple[NDArray[np.float64], NDArray[np.uint8] | None]  # (P, 3) points, (P, 3) RGB or None


def read_optional_cloud(path: Path | None) -> PointCloud:
    """The vertices of a PLY; no points without a path. Raises PlyError as `read_point_cloud` does."""
    return read_point_cloud(path) if path is not None else (np.empty((0, 3)), None)


def read_point_cloud(path: Path) -> PointCloud:
    """The vertices of a PLY. Colours are uchar `red green blue`, or `diffuse_red` and so on.

    Raises:
        PlyError: no such PLY, truncated, a number that is not finite, or more than `MOST_POINTS` vertices.
        OSError: it cannot be read.
    """
    if not path.is_file():
        raise PlyError(f"{path}: there is no such point cloud")
    with path.open("rb") as file:
        head = file.read(4096)
    ascii_ply = re.match(rb"ply\s+format ascii ", head) is not None
    points, colors = _read_ascii(path) if ascii_ply else _read_binary(path)
    sound = (np.abs(points) < LARGEST).all(axis=1)
    if not sound.all():
        raise PlyError(f"{path}: vertex {int(np.argmin(sound))} is not finite; remove it")
    return points, colors


def _read_binary(path: Path) -> PointCloud:
    table = read_table(path)
    if table.count > MOST_POINTS:
        raise PlyError(
            f"{path}: {table.count:,} points are no sparse cloud; thin it out below {MOST_POINTS:,}"
        )
    names = table.dtype.names or ()
    position, color = _columns(path, names)
    rows = table.rows(0, table.count)
    points = np.stack([rows[name].astype(np.float64) for name in position], axis=1)
    if not color:
        return points, None
    if any(table.dtype[name] != np.uint8 for name in color):
        raise PlyError(f"{path}: the colours are not 8 bit; save them as uchar")
    return points, np.stack([rows[name] for name in color], axis=1)


def _read_ascii(path: Path) -> PointCloud:
    """As openMVG writes by default: each line is a vertex."""
    with path.open("rb") as file:
        count, names = _ascii_header(path, file)
        if count > min(
            MOST_POINTS, path.stat().st_size // 6
        ):  # a vertex has at least `0 0 0` and a line's end
            raise PlyError(f"{path}: its header promises {count:,} vertices, more than there can be")
        position, color = _columns(path, names)
        wanted = [names.index(name) for name in position + color]
        table = np.empty((count, len(wanted)))
        for row in range(count):
            words = file.readline(_LONGEST_LINE).split()
            try:
                table[row] = [float(words[column]) for column in wanted]
            except (ValueError, IndexError) as error:
                raise PlyError(f"{path}: vertex {row} cannot be read; export the cloud again") from error
    if not color:
        return table, None
    if not ((table[:, 3:] >= 0) & (table[:, 3:] <= 255)).all():
        raise PlyError(f"{path}: the colours are not from 0 to 255; save them as uchar")
    return table[:, :3].copy(), table[:, 3:].astype(np.uint8)


def _ascii_header(path: Path, file: BinaryIO) -> tuple[int, list[str]]:
    """(vertices, their properties); the file stands at the first vertex."""
    count, names, elements = None, [], 0
    for _ in range(1000):
        words = file.readline(_LONGEST_LINE).decode("utf-8", "replace").split()
        if words == ["end_header"]:
            if count is None:
                break
            return count, names
        if words[:1] == ["element"]:
            elements += 1
            if words[1:2] == ["vertex"] and elements == 1 and len(words) == 3 and words[2].isdecimal():
                count = int(words[2][:18])
        elif words[:1] == ["property"] and elements == 1:
            names.append(words[-1])
    raise PlyError(f"{path}: the header of the PLY has no vertices first, or no end; export it again")


def _columns(path: Path, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """The names of the position's columns and of the colour's, which may be missing."""
    if missing := [name for name in _POSITION if name not in names]:
        raise PlyError(f"{path}: the point cloud has no column {missing[0]}")
    for prefix in ("", "diffuse_"):
        if all(prefix + name in names for name in _COLOR):
            return list(_POSITION), [prefix + name for name in _COLOR]
    return list(_POSITION), []
