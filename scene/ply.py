"""Gaussians as PLY, the layout that every viewer reads. All ways stream, so memory stays constant.

Columns, all float32, little-endian: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..44 (channel-major: the 15
coefficients of red, then of green, then of blue), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z).
Sky Gaussians are last; the header comment `panolog sky N` says how many they are. A comment
`panolog offset X Y Z` is what to add to positions for those of the scene's COLMAP model. A comment
`panolog projection exact` says that they were trained along the rays of pixels (`Gaussians.exact`), and
`panolog frame export` that they were turned for viewers. Such files may have fewer f_rest columns.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from io import FileIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from panolog.scene.errors import PlyError
from panolog.scene.files import StrPath, atomic, write_all
from panolog.scene.gaussians import SH_REST, Gaussians
from panolog.scene.model import NO_OFFSET, Vector
from panolog.scene.ply_table import EXPORTED, Table, exact_of, offset_of, read_table, sky_of

CHUNK = 16_384  # rows in memory at a time: 4 MB
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * SH_REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
_BOUNDED = ("opacity", "scale_0", "scale_1", "scale_2")  # exports write an infinite one as a finite one
_REST_OF_DEGREE = (0, 3, 8, 15)  # coefficients of one channel beyond degree 0
_ROW = np.dtype([(name, "<f4") for name in COLUMNS])


def write_ply(path: StrPath, gaussians: Gaussians, *, offset: Vector = NO_OFFSET) -> None:
    """Writes Gaussians as a PLY, atomically.

    Args: offset, `Scene.offset`, for a comment; the positions are written as they are.
    Raises OSError: the file cannot be written.

    >>> import panolog
    >>> panolog.write_ply("model.ply", panolog.initial_gaussians(panolog.read_scene(SCENE)))
    """
    parts, count = [gaussians], len(gaussians)
    write_ply_parts(Path(path), parts, count=count, sky=gaussians.sky, offset=offset, exact=gaussians.exact)


def write_ply_parts(
    path: Path,
    parts: Iterable[Gaussians],
    *,
    count: int,
    sky: int,
    offset: Vector = NO_OFFSET,
    exact: bool = False,
    exported: int | None = None,
) -> None:
    """Writes the Gaussians of all parts, in order, atomically.

    Args:
        parts: any number of Gaussians; the sky of all of them together is the last `sky` rows.
        count: rows of all parts together, because the header comes first.
        sky: how many of them, at the end, are sky.
        exact: `Gaussians.exact` of all of them.
        exported: degree of the spherical harmonics of a file for viewers, to which they were turned.

    Raises ValueError: the parts are not `count` rows, or their sky is not the last `sky` rows; OSError: the
    file cannot be written.
    """
    rest = SH_REST if exported is None else _REST_OF_DEGREE[exported]
    with atomic(path) as temporary, temporary.open("wb") as file:
        file.write(_header(count, sky, offset, exact, rest, exported=exported is not None))
        written = 0
        for part in parts:
            first_sky = written + len(part) - part.sky
            if first_sky != max(written, min(written + len(part), count - sky)):
                raise ValueError(f"sky is not the last {sky} of {count} Gaussians")
            for start in range(0, len(part), CHUNK):
                file.write(_encode(part, slice(start, start + CHUNK), rest).tobytes())
            written += len(part)
        if written != count:
            raise ValueError(f"{written} Gaussians were given, {count} were announced")


def join_ply(
    path: Path,
    parts: Sequence[tuple[Path, range | NDArray[np.bool_]]],
    last: Gaussians | None = None,
    *,
    sky: int,
    offset: Vector = NO_OFFSET,
    exact: bool = False,
) -> int:
    """Writes rows of other PLYs, in order, as they stand there, atomically: at the speed of the disk.

    Args:
        parts: files that `write_ply` wrote, each with its rows to take: a range with step 1, or (N,) which.
        last: a few Gaussians that are in no file, after them.
        sky: how many rows, at the end of all, are sky.
        exact: `Gaussians.exact` of all of them.

    Returns the number of Gaussians written.
    Raises PlyError: a file is truncated, or has another layout; OSError: a file cannot be read or written.
    """
    count = sum(len(rows) if isinstance(rows, range) else int(rows.sum()) for _, rows in parts)
    count += len(last) if last else 0
    with atomic(path) as temporary, temporary.open("wb", buffering=0) as file:
        file.write(_header(count, sky, offset, exact))
        for source, rows in parts:
            table = read_table(source)
            if table.dtype != _ROW:
                raise PlyError(f"{source}: has other columns than PanoLOG writes; write it again")
            if isinstance(rows, range):
                _copy_rows(table, rows, file)
            else:
                _copy_some(table, np.flatnonzero(rows), file)
        if last:
            write_all(file, memoryview(_encode(last, slice(None), SH_REST).tobytes()))
    return count


def read_ply(path: StrPath) -> Gaussians:
    """All Gaussians of a PLY, also of other trainers: columns go by name, a lower SH degree is padded with 0.

    Needs hardly more memory than they take.

    Raises PlyError: not a binary PLY of Gaussians, or truncated.

    >>> import panolog
    >>> len(panolog.read_ply(MODEL))
    50
    """
    table, rest, sky = _open(Path(path))
    none = _decode(table, slice(0, 0), rest, 0)
    whole = {name: torch.empty(table.count, *tensor.shape[1:]) for name, tensor in none.tensors().items()}
    start = 0
    for piece in read_ply_chunks(Path(path)):
        for name, tensor in piece.tensors().items():
            whole[name][start : start + len(piece)] = tensor
        start += len(piece)
    return none.with_tensors(whole, sky=sky)


def read_ply_chunks(path: Path, rows: int = CHUNK) -> Iterator[Gaussians]:
    """The Gaussians of `read_ply` in order, at most `rows` at a time.

    Raises PlyError: not a binary PLY of Gaussians, or truncated.
    """
    table, rest, sky = _open(path)
    for start in range(0, table.count, rows):
        stop = min(start + rows, table.count)
        yield _decode(table, slice(start, stop), rest, max(0, stop - max(start, table.count - sky)))


def read_scene_means(path: Path) -> NDArray[np.float32]:
    """(N - sky, 3) positions of the Gaussians of `read_ply` that are scene. Raises PlyError as it does."""
    table, _, sky = _open(path)
    means = np.empty((table.count - sky, 3), np.float32)
    for start in range(0, len(means), CHUNK):
        rows = table.rows(start, min(start + CHUNK, len(means)))
        for column, axis in enumerate("xyz"):
            means[start : start + len(rows), column] = rows[axis]
    return means


def read_sky(path: Path) -> Gaussians:
    """The Gaussians of `read_ply` that are sky. Raises PlyError as it does."""
    table, rest, sky = _open(path)
    return _decode(table, slice(table.count - sky, table.count), rest, sky)


def ply_header(path: Path) -> tuple[int, int]:
    """(Gaussians, how many of them at the end are sky).

    Raises PlyError: not a binary PLY of Gaussians, or truncated.
    """
    table, _, sky = _open(path)
    return table.count, sky


def ply_offset(path: Path) -> Vector:
    """What was subtracted from its positions: `Scene.offset`. Raises PlyError as `ply_header`."""
    return offset_of(_open(path)[0])


def ply_exact(path: Path) -> bool:
    """`Gaussians.exact` of all of them. Raises PlyError as `ply_header`."""
    return exact_of(_open(path)[0])


def ply_exported(path: Path) -> bool:
    """Whether it was turned for viewers. Raises PlyError as `ply_header`."""
    return EXPORTED in _open(path)[0].comments


def describe_faults(path: Path) -> list[str]:
    """What is wrong with the Gaussians of a PLY, one line for each kind. Raises PlyError as `ply_header`."""
    table, _, _ = _open(path)
    numbers = [name for name in COLUMNS if name in (table.dtype.names or ()) and name[0] != "n"]
    lost = infinite = empty = 0
    for start in range(0, table.count, CHUNK):
        rows = table.rows(start, min(start + CHUNK, table.count))
        inside = [rows[name].clip(-1, 1) if name in _BOUNDED else rows[name] for name in numbers]
        kept = np.all(np.isfinite(inside), axis=0)
        lost += int((~kept).sum())
        infinite += int((kept & np.any([np.isinf(rows[name]) for name in _BOUNDED], axis=0)).sum())
        empty += int(np.all([rows[f"rot_{axis}"] == 0 for axis in range(4)], axis=0).sum())
    lines, of = [], f"of {table.count:,} Gaussians have"
    if lost:
        lines.append(f"{path}: {lost:,} {of} numbers that are not finite; exports leave them out")
    if infinite:
        lines.append(
            f"{path}: {infinite:,} {of} an infinite opacity or size; exports bound it, and renders leave "
            "them out"
        )
    if empty:
        lines.append(
            f"{path}: {empty:,} {of} a rotation of zeros, as rows have that a program did not write; export "
            "the model again"
        )
    return lines


def _header(
    count: int, sky: int, offset: Vector, exact: bool, rest: int = SH_REST, *, exported: bool = False
) -> bytes:
    unused = {f"f_rest_{i}" for i in range(3 * rest, 3 * SH_REST)}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment panolog sky {sky}",
        *([f"comment panolog offset {' '.join(map(repr, offset))}"] if any(offset) else []),
        *(["comment panolog projection exact"] if exact else []),
        *([f"comment {EXPORTED}"] if exported else []),
        f"element vertex {count}",
        *(f"property float {name}" for name in COLUMNS if name not in unused),
        "end_header\n",
    ]
    return "\n".join(lines).encode()


def _copy_rows(table: Table, rows: range, file: FileIO) -> None:
    """Appends rows to an unbuffered file; the kernel copies them."""
    size = table.dtype.itemsize
    start, stop = (table.offset + row * size for row in (rows.start, rows.stop))
    with table.path.open("rb", buffering=0) as source:
        while start < stop:
            copied = os.sendfile(file.fileno(), source.fileno(), start, stop - start)
            if not copied:
                raise PlyError(f"{table.path}: truncated while it was read; copy it again")
            start += copied


def _copy_some(table: Table, rows: NDArray[np.int64], file: FileIO) -> None:
    """Appends single rows to an unbuffered file; of the others no more is read than shares their pages."""
    records = np.memmap(table.path, table.dtype, "r", table.offset, (table.count,))
    for start in range(0, len(rows), CHUNK):
        write_all(file, memoryview(records[rows[start : start + CHUNK]].tobytes()))


def _encode(part: Gaussians, rows: slice, rest: int) -> NDArray[np.float32]:
    """(n, 17 + 3 rest) rows as they stand in the file, with `rest` coefficients beyond degree 0."""
    piece = {name: tensor[rows].detach().cpu().to(torch.float32) for name, tensor in part.tensors().items()}
    n = len(piece["means"])
    table = torch.cat(
        [
            piece["means"],
            torch.zeros(n, 3),
            piece["sh0"].reshape(n, 3),
            piece["shN"][:, :rest].transpose(1, 2).reshape(n, 3 * rest),
            piece["opacities"].reshape(n, 1),
            piece["scales"],
            piece["quats"],
        ],
        dim=1,
    )
    encoded: NDArray[np.float32] = table.numpy().astype("<f4", copy=False)
    return encoded


def _open(path: Path) -> tuple[Table, int, int]:
    """(table, SH coefficients of one channel beyond degree 0, sky) of a PLY of Gaussians."""
    table = read_table(path)
    names = table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest % 3 or rest // 3 not in _REST_OF_DEGREE:
        raise PlyError(f"{path}: {rest} f_rest columns belong to no SH degree from 0 to 3")
    wanted = [name for name in COLUMNS if name[0] != "n" and not name.startswith("f_rest_")]
    wanted += [f"f_rest_{i}" for i in range(rest)]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise PlyError(f"{path}: not a PLY of 3D Gaussians, it has no column {missing[0]}")
    return table, rest // 3, sky_of(table)


def _decode(table: Table, part: slice, rest: int, sky: int) -> Gaussians:
    """Rows of a table with `rest` coefficients of one channel beyond degree 0, the last `sky` of them sky."""
    rows = table.rows(part.start, part.stop)

    def columns(prefix: str, n: int) -> torch.Tensor:
        out = np.empty((len(rows), n), np.float32)
        for i in range(n):
            out[:, i] = rows[f"{prefix}{i}"]
        return torch.from_numpy(out)

    shN = torch.zeros(len(rows), SH_REST, 3)
    shN[:, :rest] = columns("f_rest_", 3 * rest).reshape(len(rows), 3, rest).transpose(1, 2)
    return Gaussians(
        means=torch.from_numpy(np.stack([rows[axis].astype(np.float32) for axis in "xyz"], axis=1)),
        quats=columns("rot_", 4),
        scales=columns("scale_", 3),
        opacities=torch.from_numpy(rows["opacity"].astype(np.float32)),
        sh0=columns("f_dc_", 3).reshape(len(rows), 1, 3),
        shN=shN,
        sky=sky,
        exact=exact_of(table),
    )
