"""GLB with Khronos' extension for Gaussians, plain or compressed as SPZ.

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
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from panolog.export.splats import REST, Splats, SplatSource
from panolog.export.spz import encode
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath, atomic

Compression = Literal["spz"] | None

BASE = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
_C0 = 0.28209479177387814  # spherical harmonic of degree 0
_FLOAT, _BYTE = 5126, 5121  # component types
_VERTICES = 34962  # target of a buffer view
_MOST = 2**32 - 1  # bytes of a GLB
_SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def write_glb(path: StrPath, source: SplatSource, compression: Compression = "spz") -> None:
    """Writes Gaussians as a GLB, atomically.

    Args:
        source: what to write, y up.
        compression: "spz" is what CesiumJS needs, a tenth of the bytes, and keeps 65 bytes of each Gaussian
            in memory. None is 240 bytes of each, reads the source twice, and keeps nothing.

    Raises FormatError: there is no Gaussian, the GLB would have 4 GiB, or the model is larger than SPZ can
    hold; OSError: the file cannot be written.
    """
    with atomic(Path(path)) as temporary, temporary.open("wb") as file:
        encode_glb(file, source, compression)


def encode_glb(file: BinaryIO, source: SplatSource, compression: Compression = "spz") -> None:
    """Writes what `write_glb` does to an open file. Raises FormatError as it does."""
    if not source.count:
        raise FormatError("there is no Gaussian to write; select more of the model")
    lower, upper = _bounds(source)
    origin = np.round((lower + upper) / 2)
    local = _Moved(source, origin)
    bounds = tuple((side - origin).astype(np.float32).tolist() for side in (lower, upper))
    if compression == "spz":
        blob = BytesIO()
        encode(blob, local)
        document = _document(origin, _attributes(source.degree, compressed=True), source.count, bounds)
        document["extensionsRequired"] = [BASE, SPZ]
        document["extensionsUsed"].append(SPZ)
        primitive = document["meshes"][0]["primitives"][0]
        primitive["extensions"][BASE]["extensions"] = {SPZ: {"bufferView": 0}}
        document["bufferViews"] = [{"buffer": 0, "byteLength": blob.tell()}]
        _write_head(file, document, blob.tell())
        file.write(blob.getbuffer())
        file.write(bytes(-blob.tell() % 4))
    else:
        _encode_plain(file, local, bounds, origin)


@dataclass(frozen=True, eq=False)
class _Moved:
    """A source around another origin."""

    source: SplatSource
    origin: NDArray[np.float64]  # (3,)

    @property
    def count(self) -> int:
        """How many there are."""
        return self.source.count

    @property
    def degree(self) -> int:
        """Of their spherical harmonics."""
        return self.source.degree

    def pieces(self) -> Iterator[Splats]:
        """All of them."""
        for piece in self.source.pieces():
            yield replace(piece, means=(piece.means - self.origin).astype(np.float32))


def _bounds(source: SplatSource) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corner (3,) of the means."""
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in source.pieces():
        lower = np.minimum(lower, piece.means.min(axis=0))
        upper = np.maximum(upper, piece.means.max(axis=0))
    return lower, upper


def _attributes(degree: int, *, compressed: bool) -> dict[str, tuple[str, int]]:
    """Type and component type by semantic: position first."""
    found = {"POSITION": ("VEC3", _FLOAT), "COLOR_0": ("VEC4", _BYTE)}
    found |= {f"{BASE}:SCALE": ("VEC3", _FLOAT), f"{BASE}:ROTATION": ("VEC4", _FLOAT)}
    if not compressed:
        found |= {f"{BASE}:OPACITY": ("SCALAR", _FLOAT), f"{BASE}:SH_DEGREE_0_COEF_0": ("VEC3", _FLOAT)}
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
            }
        },
    }
    return {
        "asset": {"version": "2.0", "generator": "panolog"},
        "extensionsUsed": [BASE],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *origin.tolist(), 1]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
    }


def _write_head(file: BinaryIO, document: dict[str, Any], size: int) -> None:
    """All of a GLB before the bytes of its buffer. Raises FormatError if it would be too large."""
    text = json.dumps(document | {"buffers": [{"byteLength": size}]}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    padded = size + -size % 4
    total = 12 + 8 + len(text) + 8 + padded
    if total > _MOST:
        raise FormatError(
            f"the GLB would have {total} bytes, and may have {_MOST}; write it with SPZ, or as tiles"
        )
    file.write(struct.pack("<4sII", b"glTF", 2, total))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", padded, b"BIN\0"))


def _encode_plain(
    file: BinaryIO, source: SplatSource, bounds: tuple[list[float], ...], origin: NDArray[np.float64]
) -> None:
    """Each attribute of all Gaussians has a place in the file, which is written piece by piece."""
    attributes = _attributes(source.degree, compressed=False)
    document = _document(origin, attributes, source.count, bounds)
    widths = [_SIZES[shape] * (4 if kind == _FLOAT else 1) for shape, kind in attributes.values()]
    offsets, views = 0, []
    for index, width in enumerate(widths):
        document["accessors"][index]["bufferView"] = index
        views.append(
            {"buffer": 0, "byteOffset": offsets, "byteLength": width * source.count, "target": _VERTICES}
        )
        offsets += width * source.count
    document["bufferViews"] = views
    _write_head(file, document, offsets)
    start, done = file.tell(), 0
    for piece in source.pieces():
        for view, width, values in zip(views, widths, _plain(piece), strict=True):
            file.seek(start + int(view["byteOffset"]) + done * width)
            file.write(np.ascontiguousarray(values).reshape(-1).data)
        done += len(piece)


def _plain(piece: Splats) -> list[NDArray[Any]]:
    """The values of `_attributes`, in their order."""
    opacities = (1 / (1 + np.exp(-piece.opacities.astype(np.float64)))).astype("<f4")
    shades = np.concatenate([piece.sh0 * _C0 + 0.5, opacities[:, None]], axis=1)
    found: list[NDArray[Any]] = [
        piece.means.astype("<f4"),
        np.rint(shades.clip(0, 1) * 255).astype(np.uint8),
        np.exp(piece.scales).astype("<f4"),
        piece.quats[:, [1, 2, 3, 0]].astype("<f4"),
        opacities,
        piece.sh0.astype("<f4"),
    ]
    return found + [piece.shN[:, k].astype("<f4") for k in range(REST[piece.degree])]
