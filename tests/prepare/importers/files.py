"""Files that several formats have: a PLY, JSON, a split, a COLMAP text model."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from tests.prepare.importers.known import Array, Known

_VERTEX = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]


def write_ply(path: Path, points: Array, colors: NDArray[np.uint8], *, ascii_ply: bool = False) -> None:
    """A cloud with doubles, as no format has to be that exact."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = np.rec.fromarrays([*points.T, *colors.T], dtype=_VERTEX)
    PlyData([PlyElement.describe(np.asarray(table), "vertex")], text=ascii_ply).write(str(path))


def write_json(path: Path, content: Any) -> None:
    """A JSON file, as people's programs write it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))


@contextmanager
def changed_json(path: Path) -> Iterator[Any]:
    """The content of a JSON file, which is written again as it is then."""
    content = json.loads(path.read_text())
    yield content
    write_json(path, content)


def write_colmap_text(
    folder: Path,
    cameras: Sequence[str],
    images: Sequence[tuple[str, int, Array, Array, Array, Sequence[int]]],
    known: Known,
) -> None:
    """A COLMAP text model: images are (name, camera, rotation, translation, pixels (M, 2), points)."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("# cameras\n" + "".join(f"{line}\n" for line in cameras))
    text = "# images\n"
    for number, (name, camera, rotation, translation, pixels, points) in enumerate(images, start=1):
        x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
        pose = " ".join(map(repr, [w, x, y, z, *translation.tolist()]))
        text += f"{number} {pose} {camera} {name}\n"
        seen = [f"{u!r} {v!r} {point}" for (u, v), point in zip(pixels.tolist(), points, strict=True)]
        text += " ".join(["1.5 2.5 -1", *seen]) + "\n"
    (folder / "images.txt").write_text(text)
    text = "# points\n"
    for row, (point, color) in enumerate(zip(known.points.tolist(), known.colors.tolist(), strict=True)):
        text += f"{row + 1} {' '.join(map(repr, point))} {' '.join(map(str, color))} 0.5\n"
    (folder / "points3D.txt").write_text(text)


def write_split(folder: Path, known: Known) -> None:
    read_stems = [Path(name).stem for name in known.names]
    (folder / "test.txt").write_text("\n".join(read_stems[2:4]) + "\n")
    (folder / "train.txt").write_text("\n".join(read_stems[:2] + read_stems[4:]) + "\n")
