"""Compressed PLY, PlayCanvas's format of models of a quarter of the bytes: what SuperSplat saves.

Facts from https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/ and the readers of
PlayCanvas's engine and of splat-transform (MIT). A PLY with three elements: `chunk`, the bounds of each 256
neighbouring Gaussians; `vertex`, four numbers of 32 bits of each Gaussian, within these bounds; and `sh`, a
byte for each coefficient of the spherical harmonics beyond degree 0, channel by channel. Positions and
logarithms of scales have 11, 10 and 11 bits, colours and the opacity 8 bits each, and rotations the three
smallest of w x y z with 10 bits each and 2 bits for which one is the largest.

Viewers that follow PlayCanvas take PLYs to be upside down, as COLMAP's worlds are: for them, turn the model's
up to −y, `Frame.upright(down)`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from panolog.export.order import means_of, morton_order, places_in
from panolog.export.splats import REST, Splats, SplatSource, packed_but_largest, quaternions, with_rows
from panolog.scene.errors import FormatError, PlyError
from panolog.scene.files import StrPath, atomic
from panolog.scene.gaussians import SH_C0

Doubles = NDArray[np.float64]
Words = NDArray[np.uint32]

_CHUNK = 256  # Gaussians
_BOUNDS = tuple(
    f"{side}_{kind}{axis}"
    for kind, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    for side in ("min", "max")
    for axis in axes
)
_PLAIN = 12  # of the bounds that files without colours in them have
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_TYPES = {"chunk": "float", "vertex": "uint", "sh": "uchar"}
_KINDS = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
_SH = 4.0  # largest coefficient of the degrees beyond
_SIZE = 20.0  # largest logarithm of a scale
_FULL = 30.0  # logit that stands for an opacity of 1, and minus it for 0
_LINES, _LONGEST = 200, 200  # of a header, and bytes of each


def write_compressed_ply(path: StrPath, source: SplatSource) -> None:
    """Writes Gaussians as a compressed PLY, atomically, in the order of `_order`.

    Reads the source three times and keeps 61 bytes of each Gaussian with spherical harmonics of degree 3.

    Raises FormatError: there is no Gaussian; OSError: the file cannot be written.
    """
    if not source.count:
        raise FormatError("there is no Gaussian to write; select more of the model")
    place = places_in(_order(means_of(source)))
    bounds = _bounds(source, place)
    words = np.empty((source.count, len(_WORDS)), "<u4")
    rest = np.empty((source.count, 3 * REST[source.degree]), np.uint8)
    for rows, piece in with_rows(source):
        own = place[rows]
        words[own], rest[own] = _pack(piece, bounds[own // _CHUNK])
    with atomic(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(_header(len(bounds), source.count, rest.shape[1]))
        for array in (bounds, words, rest):
            file.write(array.reshape(-1).data)


def read_compressed_ply(path: StrPath) -> Splats:
    """All Gaussians of a compressed PLY.

    Raises PlyError: no compressed PLY, truncated, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise PlyError(f"{path}: there is no such file")
    with path.open("rb") as file:
        elements = _read_header(path, file)
        start = file.tell()
    tables: dict[str, NDArray[Any]] = {}
    for name, (count, dtype) in elements.items():
        tables[name] = np.fromfile(path, dtype, count, offset=start)
        start += count * dtype.itemsize
    chunks = np.stack([tables["chunk"][name] for name in tables["chunk"].dtype.names or ()], axis=1)
    if not np.isfinite(chunks).all() or np.abs(chunks[:, 6:12]).max(initial=0) > _SIZE:
        raise PlyError(
            f"{path}: bounds of chunks are no numbers, or sizes beyond e^{_SIZE:g}; write it again"
        )
    return _unpacked(tables["vertex"], chunks.astype(np.float64), tables.get("sh"))


def _order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) rows of means (N, 3) in Morton order, within shells of which each reaches four times as far.

    A chunk with both scene and sky in it has the grid of the sky, units apart, for the scene too.
    """
    far = np.abs(means - np.median(means, axis=0)).max(axis=1)
    shells, order = (np.frexp(far)[1] + 1) // 2, morton_order(means)
    return order[np.argsort(shells[order], kind="stable")]


def _columns(piece: Splats) -> Doubles:
    """(N, 9) what has bounds: the position, the logarithms of the scales, and the colour."""
    sizes = piece.scales.clip(-_SIZE, _SIZE)
    return np.concatenate([piece.means, sizes, piece.sh0 * SH_C0 + 0.5], axis=1).astype(np.float64)


def _bounds(source: SplatSource, place: NDArray[np.int32]) -> NDArray[np.float32]:
    """(chunks, 18) in the order of `_BOUNDS`."""
    chunks = -(-len(place) // _CHUNK)
    lower = np.full((chunks, 9), np.inf, np.float32)
    upper = -lower
    for rows, piece in with_rows(source):
        columns, chunk = _columns(piece).astype(np.float32), place[rows] // _CHUNK
        np.minimum.at(lower, chunk, columns)
        np.maximum.at(upper, chunk, columns)
    parts = [side[:, at : at + 3] for at in (0, 3, 6) for side in (lower, upper)]
    return np.concatenate(parts, axis=1)


def _pack(piece: Splats, bounds: NDArray[np.float32]) -> tuple[Words, NDArray[np.uint8]]:
    """The words (N, 4) and spherical harmonics (N, 3 K). Args: bounds (N, 18) of each one's chunk."""
    sides = bounds.astype(np.float64).reshape(-1, 3, 2, 3)
    lower, upper = sides[:, :, 0].reshape(-1, 9), sides[:, :, 1].reshape(-1, 9)
    span = upper - lower
    shares = ((_columns(piece) - lower) / np.where(span > 0, span, 1)).clip(0, 1)
    opacities = 1 / (1 + np.exp(-piece.opacities.astype(np.float64)))
    colors = np.concatenate([shares[:, 6:], opacities[:, None]], axis=1)
    words = [
        _joined(shares[:, :3], (11, 10, 11)),
        _pack_rotations(piece.quats),
        _joined(shares[:, 3:6], (11, 10, 11)),
        _joined(colors, (8, 8, 8, 8)),
    ]
    rest = np.floor((piece.shN / (2 * _SH) + 0.5) * 256).clip(0, 255).astype(np.uint8)
    return np.stack(words, axis=1), rest.transpose(0, 2, 1).reshape(len(piece), -1)


def _joined(shares: Doubles, bits: tuple[int, ...]) -> Words:
    """(N,) of numbers in [0, 1] (N, len(bits)), the first in the upper bits."""
    joined = np.zeros(len(shares), np.uint32)
    for column, width in enumerate(bits):
        code = np.rint(shares[:, column] * (2**width - 1)).astype(np.uint32)
        joined = joined << np.uint32(width) | code
    return joined


def _apart(words: Words, bits: tuple[int, ...]) -> Doubles:
    """(N, len(bits)) in [0, 1] of what `_joined` gives."""
    shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
    masks = np.array([2**width - 1 for width in bits])
    return np.asarray((words[:, None] >> shifts.astype(np.uint32) & masks.astype(np.uint32)) / masks)


def _pack_rotations(quats: NDArray[np.float32]) -> Words:
    largest = np.abs(quats).argmax(axis=1)
    q = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    codes = np.rint((q * np.sqrt(0.5) + 0.5).clip(0, 1) * 1023).astype(np.uint32)
    return packed_but_largest(codes, largest)


def _unpack_rotations(words: Words) -> NDArray[np.float32]:
    """(N, 4) w x y z, unit."""
    others = (_apart(words, (2, 10, 10, 10))[:, 1:] - 0.5) * np.sqrt(2.0)
    return np.asarray(quaternions(others, words >> 30), np.float32)


def _unpacked(vertices: NDArray[Any], chunks: Doubles, rest: NDArray[Any] | None) -> Splats:
    """All Gaussians, a part at a time. Args: chunks (M, 12 or 18), the bounds."""
    count = len(vertices)
    columns = 0 if rest is None else len(rest.dtype.names or ())
    codes = np.zeros((count, 0), np.uint8) if rest is None else rest.view(np.uint8).reshape(count, columns)

    def part(rows: slice) -> dict[str, NDArray[Any]]:
        own = chunks[np.arange(rows.start, rows.stop) // _CHUNK]
        return _unpack(vertices[rows], own, codes[rows])

    return Splats.made(count, REST.index(columns // 3), part)


def _unpack(vertices: NDArray[Any], bounds: Doubles, codes: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    positions = _apart(vertices["packed_position"], (11, 10, 11))
    sizes = _apart(vertices["packed_scale"], (11, 10, 11))
    colors = _apart(vertices["packed_color"], (8, 8, 8, 8))
    shades = colors[:, :3]
    if bounds.shape[1] > _PLAIN:
        shades = bounds[:, 12:15] * (1 - shades) + bounds[:, 15:18] * shades
    with np.errstate(divide="ignore"):
        opacities = np.log(colors[:, 3]) - np.log1p(-colors[:, 3])
    sh = np.where(codes == 0, 0, np.where(codes == 255, 1, (codes + 0.5) / 256)) - 0.5
    return {
        "means": bounds[:, 0:3] * (1 - positions) + bounds[:, 3:6] * positions,
        "quats": _unpack_rotations(vertices["packed_rotation"]),
        "scales": bounds[:, 6:9] * (1 - sizes) + bounds[:, 9:12] * sizes,
        "opacities": opacities.clip(-_FULL, _FULL),
        "sh0": (shades - 0.5) / SH_C0,
        "shN": (sh * (2 * _SH)).reshape(len(codes), 3, -1).transpose(0, 2, 1),
    }


def _header(chunks: int, count: int, rest: int) -> bytes:
    elements = {"chunk": (chunks, _BOUNDS), "vertex": (count, _WORDS)}
    if rest:
        elements["sh"] = (count, tuple(f"f_rest_{i}" for i in range(rest)))
    lines = ["ply", "format binary_little_endian 1.0", "comment written by panolog"]
    for name, (rows, columns) in elements.items():
        lines += [f"element {name} {rows}", *(f"property {_TYPES[name]} {column}" for column in columns)]
    return "\n".join([*lines, "end_header\n"]).encode()


def _read_header(path: Path, file: BinaryIO) -> dict[str, tuple[int, np.dtype[Any]]]:
    """Rows and their type by element, in the order of the file, which has all of them."""
    lines = list(_lines(path, file))
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise PlyError(f"{path}: is no compressed PLY, which is binary and little-endian")
    found: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for words in lines[2:]:
        match words:
            case ["comment" | "obj_info", *_]:
                pass
            case ["element", name, rows] if rows.isdecimal() and len(rows) < 10 and name not in found:
                found[name] = int(rows), []
            case ["property", kind, name] if kind in _KINDS and found:
                found[list(found)[-1]][1].append((name, kind))
            case _:
                raise PlyError(f"{path}: is no compressed PLY; its header has `{' '.join(words)}`")
    counts = {name: rows for name, (rows, _) in found.items()}
    count, chunks = counts.get("vertex", 0), counts.get("chunk", 0)
    if not _as_expected(found) or chunks != -(-count // _CHUNK) or counts.get("sh", count) != count:
        raise PlyError(f"{path}: is no compressed PLY as PlayCanvas defines it; compress it again")
    dtypes = {name: np.dtype([(key, _KINDS[kind]) for key, kind in own]) for name, (_, own) in found.items()}
    missing = sum(rows * dtypes[name].itemsize for name, rows in counts.items())
    missing -= path.stat().st_size - file.tell()
    if missing > 0:
        raise PlyError(f"{path}: truncated, {missing} bytes are missing; copy it again")
    return {name: (rows, dtypes[name]) for name, rows in counts.items()}


def _as_expected(found: dict[str, tuple[int, list[tuple[str, str]]]]) -> bool:
    """Whether these are the elements of a compressed PLY, with their properties."""
    rest = len(found["sh"][1]) if "sh" in found else 0
    rests = tuple(f"f_rest_{i}" for i in range(rest))
    right = {"chunk": (_BOUNDS, _BOUNDS[:_PLAIN]), "vertex": (_WORDS,)} | ({"sh": (rests,)} if rest else {})
    if list(found) != list(right) or rest // 3 not in REST or rest % 3:
        return False
    return all(
        tuple(name for name, _ in own) in right[element] and all(kind == _TYPES[element] for _, kind in own)
        for element, (_, own) in found.items()
    )


def _lines(path: Path, file: BinaryIO) -> Iterator[list[str]]:
    """The words of the header's lines but the last; `file` is then at the first row."""
    for _ in range(_LINES):
        line = file.readline(_LONGEST)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        if words:
            yield words
    raise PlyError(f"{path}: is no compressed PLY, or its header is damaged")
