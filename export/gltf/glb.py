"""GLB with Khronos' extension for Gaussians, compressed as SPZ.

Facts: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting, ratified:
a primitive of points with attributes for position, rotation (x y z w), scale (linear), opacity (0 to 1) and
spherical harmonics. How SPZ is in it, KHR_gaussian_splatting_compression_spz_2, is a draft; CesiumJS 1.145
reads it so: the SPZ is buffer view 0, its numbers are glTF's (nothing is turned), the attributes are
accessors without data, the colour is COLOR_0 in place of degree 0 and opacity, and the first node has a
`matrix`.

glTF is y up, as `Frame.upright` makes it. Coordinates are small: the node's matrix moves them back.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.export.order import means_of
from panolog.export.splats import Splats, SplatSource
from panolog.export.spz import encode
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath, atomic

BASE = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
_FLOAT, _BYTE = 5126, 5121  # component types
_MOST = 2**32 - 1  # bytes of a GLB


def write_glb(path: StrPath, source: SplatSource) -> None:
    """Writes Gaussians, y up, as a GLB, atomically; keeps 65 bytes of each in memory.

    Raises FormatError: there is no Gaussian, the GLB would have 4 GiB, or the model is larger than SPZ can
    hold; OSError: the file cannot be written.
    """
    with atomic(Path(path)) as temporary, temporary.open("wb") as file:
        encode_glb(file, source)


def encode_glb(file: BinaryIO, source: SplatSource) -> None:
    """Writes what `write_glb` does to an open file. Raises FormatError as it does."""
    if not source.count:
        raise FormatError("there is no Gaussian to write; select more of the model")
    means = means_of(source)
    lower, upper = (side.astype(np.float64) for side in (means.min(axis=0), means.max(axis=0)))
    del means
    origin = np.round((lower + upper) / 2)
    local = _Moved(source, origin)
    bounds = tuple((side - origin).astype(np.float32).tolist() for side in (lower, upper))
    blob = BytesIO()
    encode(blob, local)
    document = _document(origin, _attributes(source.degree), source.count, bounds)
    document["bufferViews"] = [{"buffer": 0, "byteLength": blob.tell()}]
    _write_head(file, document, blob.tell())
    file.write(blob.getbuffer())
    file.write(bytes(-blob.tell() % 4))


@dataclass(frozen=True, eq=False)
class _Moved:
    """A source around another origin."""

    source: SplatSource
    origin: NDArray[np.float64]  # (3,)

    @property
    def count(self) -> int:
        return self.source.count

    @property
    def degree(self) -> int:
        return self.source.degree

    def pieces(self) -> Iterator[Splats]:
        for piece in self.source.pieces():
            yield replace(piece, means=(piece.means - self.origin).astype(np.float32))


def _attributes(degree: int) -> dict[str, tuple[str, int]]:
    """Type and component type by semantic: position first."""
    found = {"POSITION": ("VEC3", _FLOAT), "COLOR_0": ("VEC4", _BYTE)}
    found |= {f"{BASE}:SCALE": ("VEC3", _FLOAT), f"{BASE}:ROTATION": ("VEC4", _FLOAT)}
    for d in range(1, degree + 1):
        found |= {f"{BASE}:SH_DEGREE_{d}_COEF_{n}": ("VEC3", _FLOAT) for n in range(2 * d + 1)}
    return found


def _document(
    origin: NDArray[np.float64],
    attributes: dict[str, tuple[str, int]],
    count: int,
    bounds: tuple[list[float], ...],
) -> dict[str, Any]:
    """The JSON of a GLB, without buffer views."""
    accessors: list[dict[str, Any]] = [
        {"componentType": kind, "count": count, "type": shape} for shape, kind in attributes.values()
    ]
    accessors[0] |= {"min": bounds[0], "max": bounds[1]}
    accessors[1]["normalized"] = True
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": 0,
        "extensions": {
            BASE: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
                "extensions": {SPZ: {"bufferView": 0}},
            }
        },
    }
    return {
        "asset": {"version": "2.0", "generator": "panolog"},
        "extensionsUsed": [BASE, SPZ],
        "extensionsRequired": [BASE, SPZ],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *origin.tolist(), 1]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
    }


def _write_head(file: BinaryIO, document: dict[str, Any], size: int) -> None:
    """Writes a GLB up to the bytes of its buffer. Raises FormatError if it would be too large."""
    text = json.dumps(document | {"buffers": [{"byteLength": size}]}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    padded = size + -size % 4
    total = 12 + 8 + len(text) + 8 + padded
    if total > _MOST:
        raise FormatError(f"the GLB would have {total} bytes, and may have {_MOST}; write it as tiles")
    file.write(struct.pack("<4sII", b"glTF", 2, total))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", padded, b"BIN\0"))
