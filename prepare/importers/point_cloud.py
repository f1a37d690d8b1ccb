"""Point clouds next to poses: PLY, binary or ASCII, with colours or without."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.importers.json_xml import MEMORY
from panolog.scene.colmap import LARGEST
from panolog.scene.errors import PlyError
from panolog.scene.ply_table import Header, point_columns, read_header, read_table, read_vertices

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
        header = read_header(path, file)
        if header.count > (most := memory // _POINT):
            raise PlyError(
                f"{path}: {header.count:,} points are too many for the memory that is free; thin the cloud "
                f"out below {most:,}"
            )
        is_ascii = header.layout == "ascii"
        points, colors = _read_ascii(path, file, header) if is_ascii else read_vertices(read_table(path))
    sound = (np.abs(points) < LARGEST).all(axis=1)
    if not sound.all():
        raise PlyError(f"{path}: vertex {int(np.argmin(sound))} is not finite; remove it")
    return points, colors


def _read_ascii(path: Path, file: BinaryIO, header: Header) -> PointCloud:
    """As openMVG writes by default: each line is a vertex."""
    if header.count > path.stat().st_size // 6:  # a vertex has at least `0 0 0` and a line's end
        raise PlyError(f"{path}: its header declares {header.count:,} vertices, more than there can be")
    names = [name for name, _ in header.properties]
    position, color = point_columns(path, names)
    used = [names.index(name) for name in position + color]
    table = np.empty((header.count, len(used)))
    for row in range(header.count):
        words = file.readline(_LONGEST_LINE).split()
        try:
            table[row] = [float(words[column]) for column in used]
        except (ValueError, IndexError) as error:
            raise PlyError(f"{path}: vertex {row} cannot be read; export the cloud again") from error
    if not color:
        return table, None
    if not ((table[:, 3:] >= 0) & (table[:, 3:] <= 255)).all():
        raise PlyError(f"{path}: the colours are not from 0 to 255; save them as uchar")
    return table[:, :3].copy(), table[:, 3:].astype(np.uint8)
