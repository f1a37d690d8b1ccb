"""Point clouds next to poses: PLY, binary or ASCII, with colours or without."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.importers.json_xml import MEMORY
from panolog.scene.colmap import LARGEST
from panolog.scene.errors import PlyError
from panolog.scene.ply_table import Table, point_columns, read_header, read_table, read_vertices

_POINT = 90  # bytes that a vertex takes while an ASCII file is read
_LONGEST_LINE = 4096  # bytes
PointCloud = tuple[NDArray[np.float64], NDArray[np.uint8] | None]  # (P, 3) points, (P, 3) RGB or None


def read_point_cloud(path: Path | None, memory: int = MEMORY) -> PointCloud:
    """The vertices of a PLY; no points without a path.

    Colours are uchar `red green blue`, or `diffuse_red` and so on.

    Raises PlyError: no such PLY, truncated, a number that is not finite, or more vertices than `memory`
    holds; OSError: it cannot be read.
    """
    if path is None:
        return np.empty((0, 3)), None
    if not path.is_file():
        raise PlyError(f"{path}: there is no such point cloud")
    with path.open("rb") as file:
        table = read_header(path, file)
        if table.count > (most := memory // _POINT):
            raise PlyError(
                f"{path}: {table.count:,} points are too many for the memory that is free; thin the cloud "
                f"out below {most:,}"
            )
        is_ascii = table.layout == "ascii"
        points, colors = _read_ascii(table, file) if is_ascii else read_vertices(read_table(path))
    sound = (np.abs(points) < LARGEST).all(axis=1)
    if not sound.all():
        raise PlyError(f"{path}: vertex {int(np.argmin(sound))} is not finite; remove it")
    return points, colors


def _read_ascii(table: Table, file: BinaryIO) -> PointCloud:
    """Reads the rows of an ASCII PLY, which openMVG writes by default: each line is a vertex.

    Args: table, what the header declares; file, at the first vertex. Raises PlyError if a row is damaged.
    """
    path = table.path
    if table.count > path.stat().st_size // 6:  # a vertex has at least `0 0 0` and a line's end
        raise PlyError(f"{path}: its header declares {table.count:,} vertices, more than there can be")
    position, color = point_columns(table)
    used = [(table.dtype.names or ()).index(name) for name in position + color]
    values = np.empty((table.count, len(used)))
    for row in range(table.count):
        words = file.readline(_LONGEST_LINE).split()
        try:
            values[row] = [float(words[column]) for column in used]
        except (ValueError, IndexError) as error:
            raise PlyError(f"{path}: vertex {row} cannot be read; export the cloud again") from error
    if not color:
        return values, None
    if not ((values[:, 3:] >= 0) & (values[:, 3:] <= 255)).all():
        raise PlyError(f"{path}: the colours are not from 0 to 255; save them as uchar")
    return values[:, :3].copy(), values[:, 3:].astype(np.uint8)
