"""3D Tiles 1.1: a model that streams onto a globe.

Facts: https://docs.ogc.org/cs/22-025r4/22-025r4.html (OGC 22-025r4), and what CesiumJS 1.145 does. Tilesets
are z up and glTF is y up: a viewer turns content by (x, y, z) -> (x, -z, y), so bounding volumes are turned
here. A leaf of the tree is a chain of tiles that replace each other: the coarsest level of detail, then finer
ones, then all of its Gaussians. Above the leaves, tiles have no content and only bound what is below.

CesiumJS takes content for Gaussians if `3DTILES_content_gltf` says that its extensions are required.
"""

import json
import shutil
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.export.detail import SIDE, Corners, Detail, Node, around
from panolog.export.gltf.glb import BASE, SPZ, encode_glb
from panolog.export.splats import InMemory, Splats, SplatSource
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath, atomic_folder, write_bytes

Doubles = NDArray[np.float64]

TILESET = "tileset.json"  # the index of a folder
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a tileset's axes of those of its content
_PIXELS = 8.0  # CesiumJS accepts errors of 16 pixels: cubes that are merged then span two
_FEWER = 0.9  # of the Gaussians of the finer level that one has at most, to be worth a file
_SIGMAS = 3.0  # of a Gaussian are within its bounding volume


def write_tiles(
    folder: StrPath,
    source: SplatSource,
    *,
    to_ecef: Doubles | None,
    side: float = SIDE,
    levels: int | None = None,
) -> None:
    """Writes a folder with `tileset.json` and a GLB of each leaf and level; it appears whole or not at all.

    Needs 236 bytes of each Gaussian on the disk while it writes, and memory for all positions and one leaf.

    Args:
        folder: what appears; it may not exist before, or is empty.
        source: what to write, y up, in metres if it has a place on the earth; without sky, whose size would
            make every tile near.
        to_ecef: (4, 4), rigid, from the tileset's axes, x, −z and y of the source's, to the earth-centred
            frame in metres: `enu_to_ecef` if the source's x is east and its −z north. None leaves the tileset
            where the source has its origin.
        side, levels: as of `Detail`.

    Raises FormatError: the folder exists already, or there is no Gaussian; OSError: the files cannot be
    written.
    """
    folder = Path(folder)
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise FormatError(f"{folder}: exists already; remove it, or choose another folder")
    if not source.count:
        raise FormatError("there is no Gaussian to write; select more of the model")
    with atomic_folder(folder) as temporary:
        scratch = temporary / "scratch"
        scratch.mkdir()
        detail = Detail(source, scratch, side=side, levels=levels)
        leaves = [_write_leaf(temporary, *leaf, detail.sides) for leaf in enumerate(detail.leaves())]
        shutil.rmtree(scratch)
        root = _tile_of(detail.tree, leaves)
        write_bytes(temporary / TILESET, _tileset(root, to_ecef))


@dataclass(frozen=True, eq=False)
class _Tile:
    """A part of the model."""

    corners: Corners  # in the tileset's axes
    error: float  # units, of what it shows
    content: str | None
    children: "tuple[_Tile, ...]"

    def json(self) -> dict[str, Any]:
        """The tile as `tileset.json` has it."""
        lower, upper = self.corners
        center, half = (lower + upper) / 2, (upper - lower) / 2
        tile: dict[str, Any] = {
            "boundingVolume": {"box": [*center.tolist(), *np.diag(half).ravel().tolist()]},
            "geometricError": self.error,
            "refine": "REPLACE",
        }
        if self.content is not None:
            tile["content"] = {"uri": self.content}
        if self.children:
            tile["children"] = [child.json() for child in self.children]
        return tile


def _tileset(root: _Tile, transform: Doubles | None) -> bytes:
    """The JSON. Not to show the model at all is an error of its size."""
    tile = root.json()
    if transform is not None:
        tile = {"transform": transform.T.ravel().tolist()} | tile  # column by column
    extensions = [BASE, SPZ]
    gltf = {"extensionsUsed": extensions, "extensionsRequired": extensions}
    tileset = {
        "asset": {"version": "1.1", "extras": {"generator": "panolog"}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": gltf},
        "geometricError": max(root.error, _size(root.corners)),
        "root": tile,
    }
    return json.dumps(tileset, separators=(",", ":")).encode()


def _tile_of(node: Node, leaves: list[_Tile]) -> _Tile:
    """The tile of a node of the tree. Without content its error is its size: from far away it is hidden."""
    if node.children is None:
        return leaves[node.leaf or 0]
    children = tuple(_tile_of(child, leaves) for child in node.children)
    corners = around([child.corners for child in children])
    return _Tile(corners, max(_size(corners), *(child.error for child in children)), None, children)


def _write_leaf(folder: Path, leaf: int, levels: tuple[Splats, ...], sides: tuple[float, ...]) -> _Tile:
    """The chain of tiles of a leaf, whose files it writes."""
    chosen = [0]
    for level in range(1, len(levels)):
        if len(levels[level]) < _FEWER * len(levels[chosen[-1]]):
            chosen.append(level)
    corners = around([_corners(levels[level]) for level in chosen])
    tile: _Tile | None = None
    for level in chosen:
        name = f"{leaf}-{level}.glb"
        blob = BytesIO()
        encode_glb(blob, InMemory(levels[level]))
        write_bytes(folder / name, blob.getvalue())
        error = sides[level] * _PIXELS
        tile = _Tile(corners, error, name, () if tile is None else (tile,))
    assert tile is not None  # level 0 is always there
    return tile


def _corners(splats: Splats) -> Corners:
    """The corners of a box in the tileset's axes that holds Gaussians."""
    turned = Rotation.from_matrix(Z_UP) * Rotation.from_quat(splats.quats, scalar_first=True)
    axes = turned.as_matrix() * np.exp(splats.scales.astype(np.float64))[:, None]
    reach = _SIGMAS * np.linalg.norm(axes, axis=2)
    means = splats.means.astype(np.float64) @ Z_UP.T
    return (means - reach).min(axis=0), (means + reach).max(axis=0)


def _size(corners: Corners) -> float:
    return float(np.linalg.norm(corners[1] - corners[0]))
