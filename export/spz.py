"""SPZ, Niantic's format of small models: versions 3 and 4 are written, 2 to 4 are read.

Facts from https://github.com/nianticlabs/spz (README, MIT), which all readers follow. Versions 2 and 3 are
one gzip stream: a header of 16 bytes, then positions, opacities, colours, scales, rotations and spherical
harmonics, each of all Gaussians, then extensions. Version 4 has a header of 32 bytes, extensions, a table of
the sizes of its streams, and each of the same streams as a zstd frame. `spz_values` has what the bytes mean.

Axes are right, up and back: those of `Frame.upright`, so that viewers show what is written upright.
"""

import gzip
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import zstandard
from numpy.typing import NDArray

from panolog.export.order import means_of, morton_order, places_in
from panolog.export.splats import REST, ROWS, Splats, SplatSource, with_rows
from panolog.export.spz_values import (
    Bytes,
    most_bits,
    pack,
    pack_positions,
    unpack,
    unpack_scales,
    widths,
)
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath, atomic

Version = Literal[3, 4]

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, streams
_EXTENDED = 2  # flag: there are extensions
_TABLE = struct.Struct("<QQ")  # compressed and plain size of a stream
_BITS = range(12, 24)  # fractional bits: 12 are the default of the reference, whose users rely on ±2048
REACH = 2.0 ** (23 - _BITS[0])  # units from the origin, in an axis, up to which positions fit
LARGEST = 380.0  # units of a Gaussian: one more is a byte of 256
_STEPS = 8.0  # of positions, at least, in the size of the smallest Gaussians
_SMALL = 0.01  # of the Gaussians are smaller
_DEGREES = 4  # of the spherical harmonics, at most, in a file
_MOST = 2**25  # Gaussians of a file that is read: 8 GB of numbers
_LEVEL = {3: 6, 4: 12}  # of compression, by version
_RATIO = 100  # of plain to compressed bytes, beyond which a file is a bomb: models are below 10
_SMALL_FILE = 2**24  # plain bytes that a file may always have
_WINDOW = 2**27  # bytes that a frame of zstd may refer back
_BLOCK = 2**20  # bytes at a time


def write_spz(path: StrPath, source: SplatSource, version: Version = 3) -> None:
    """Writes Gaussians as an SPZ, atomically, in Morton order.

    Keeps 65 bytes of each in memory with spherical harmonics of degree 3. Positions get as many fractional
    bits as the smallest Gaussians need, at least 12, if all positions then fit; the header says how many.

    Args:
        version: 3 is what all readers know but PlayCanvas's engine, which reads 4 alone (Spark 2.2 does not).

    Raises FormatError: there is no Gaussian, or one is more than 2048 units from the origin in an axis;
    OSError: the file cannot be written.
    """
    with atomic(Path(path)) as temporary, temporary.open("w+b") as file:
        encode(file, source, version)


def encode(file: BinaryIO, source: SplatSource, version: Version = 3) -> None:
    """Writes what `write_spz` does to a file that can be sought. Raises FormatError as it does."""
    if not source.count:
        raise FormatError("there is no Gaussian to write; select more of the model")
    means = means_of(source)
    extent = float(np.abs(means).max())
    if not np.isfinite(extent) or most_bits(extent) < _BITS[0]:
        raise FormatError(
            f"a Gaussian is {extent:.0f} units from the origin, and SPZ holds ±{REACH:.0f}; "
            f"crop the model, or leave out what is far with --max-distance"
        )
    order = morton_order(means)
    streams = _packed(source, order)
    bits = _fractional_bits(extent, streams["scales"])
    means = means[order]
    del order
    starts = range(0, len(means), ROWS)
    pieces = (pack_positions(means[start : start + ROWS], bits).data.cast("B") for start in starts)
    header = [_MAGIC, version, source.count, source.degree, bits, 0, 0]
    if version == 4:
        header[-1] = 1 + len(streams)
        _write_frames(file, _HEADER.pack(*header), pieces, streams)
    else:
        _write_gzip(file, _HEADER.pack(*header), pieces, streams)


def read_spz(path: StrPath) -> Splats:
    """All Gaussians of an SPZ of version 2, 3 or 4; degree 4 of spherical harmonics is left out.

    Raises FormatError: no SPZ, another version, truncated, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: there is no such file")
    with path.open("rb") as file:
        return decode(file, str(path))


def decode(file: BinaryIO, name: str) -> Splats:
    """The Gaussians of an SPZ, as `read_spz` does. Args: file, at its start; name, for messages."""
    size = file.seek(0, 2)
    file.seek(0)
    start = file.read(4)
    file.seek(0)
    try:
        if start[:2] == b"\x1f\x8b":
            return _read_gzip(file, name, size)
        if start == struct.pack("<I", _MAGIC):
            return _read_frames(file, name, size)
    except (EOFError, struct.error) as error:
        raise FormatError(f"{name}: the SPZ is truncated; copy it again") from error
    except (gzip.BadGzipFile, zlib.error, zstandard.ZstdError) as error:
        raise FormatError(f"{name}: the SPZ is damaged, and cannot be decompressed; copy it again") from error
    raise FormatError(f"{name}: is no SPZ; its first bytes are neither gzip nor NGSP")


@dataclass(frozen=True)
class _Header:
    """The header of a file, checked."""

    version: int
    count: int
    degree: int
    bits: int
    extended: bool
    streams: int  # of version 4

    @staticmethod
    def read(packed: bytes, name: str, size: int, versions: tuple[int, ...]) -> "_Header":
        """Args: packed, its first 16 bytes; name of the file; its size; versions that it may be of."""
        magic, version, count, degree, bits, flags, streams = _HEADER.unpack(packed)
        if magic != _MAGIC or version not in versions:
            raise FormatError(f"{name}: is no SPZ of version 2, 3 or 4; convert it with a newer program")
        if degree > _DEGREES or bits not in range(24):
            raise FormatError(f"{name}: the header of the SPZ is damaged; copy the file again")
        plain = count * sum(widths(degree, version).values())
        if count > _MOST or plain > max(size * _RATIO, _SMALL_FILE):
            raise FormatError(f"{name}: {count} Gaussians cannot be in an SPZ of {size} bytes; copy it again")
        return _Header(version, count, degree, bits, bool(flags & _EXTENDED), streams)


def _packed(source: SplatSource, order: NDArray[np.int64]) -> dict[str, Bytes]:
    """All streams but the positions, in that order."""
    place = places_in(order)
    sizes = {name: width for name, width in widths(source.degree, 3).items() if width and name != "positions"}
    streams = {name: np.empty((len(order), width), np.uint8) for name, width in sizes.items()}
    for rows, piece in with_rows(source):
        for name, values in pack(piece).items():
            streams[name][place[rows]] = values
    return streams


def _fractional_bits(extent: float, scales: Bytes) -> int:
    """The fewest bits that the smallest Gaussians need: lower bits are noise, which does not compress."""
    middle = np.partition(scales, 1, axis=1)[:, 1]
    small = np.sort(middle)[int(len(middle) * _SMALL)]
    size = float(np.exp(unpack_scales(np.array([small], np.uint8)))[0])
    needed = int(np.ceil(np.log2(_STEPS / size)))
    return min(max(needed, _BITS[0]), most_bits(extent), _BITS[-1])


def _blocks(array: Bytes) -> Iterator[memoryview]:
    flat = array.data.cast("B")
    for start in range(0, len(flat), _BLOCK):
        yield flat[start : start + _BLOCK]


def _write_gzip(
    file: BinaryIO, header: bytes, positions: Iterator[memoryview], streams: dict[str, Bytes]
) -> None:
    packer = zlib.compressobj(_LEVEL[3], zlib.DEFLATED, 16 + zlib.MAX_WBITS, 9)  # of no time and no name
    file.write(packer.compress(header))
    for piece in positions:
        file.write(packer.compress(piece))
    for stream in streams.values():
        for block in _blocks(stream):
            file.write(packer.compress(block))
    file.write(packer.flush())


def _write_frames(
    file: BinaryIO, header: bytes, positions: Iterator[memoryview], streams: dict[str, Bytes]
) -> None:
    """The table comes first and is known last: it is written twice."""
    start, count = file.tell(), 1 + len(streams)
    head = header + struct.pack("<I12x", 32)
    file.write(head + bytes(_TABLE.size * count))
    plain = 9 * len(next(iter(streams.values())))
    table = [_TABLE.pack(_write_frame(file, positions, plain), plain)]
    for stream in streams.values():
        table.append(_TABLE.pack(_write_frame(file, _blocks(stream), stream.size), stream.size))
    end = file.tell()
    file.seek(start + len(head))
    file.write(b"".join(table))
    file.seek(end)


def _write_frame(file: BinaryIO, blocks: Iterator[memoryview], plain: int) -> int:
    """One frame of zstd; how many bytes it has."""
    start = file.tell()
    packer = zstandard.ZstdCompressor(level=_LEVEL[4]).compressobj(size=plain)
    for block in blocks:
        file.write(packer.compress(block))
    file.write(packer.flush())
    return file.tell() - start


def _read_gzip(file: BinaryIO, name: str, size: int) -> Splats:
    with gzip.GzipFile(fileobj=file) as plain:
        header = _Header.read(plain.read(_HEADER.size), name, size, (2, 3))
        sizes = widths(header.degree, header.version)
        streams = {key: _exactly(plain, header.count, width) for key, width in sizes.items()}
        # At the end of the stream its checksum is compared.
        if plain.read(1) and not header.extended:
            raise FormatError(f"{name}: the SPZ has more than its header says; copy it again")
    return _unpacked(streams, header)


def _read_frames(file: BinaryIO, name: str, size: int) -> Splats:
    header = _Header.read(file.read(_HEADER.size), name, size, (4,))
    (table,) = struct.unpack("<I12x", file.read(16))
    sizes = {key: width for key, width in widths(header.degree, 4).items() if width}
    if header.streams != len(sizes) or table < 32:
        raise FormatError(
            f"{name}: the SPZ has {header.streams} streams, and not {len(sizes)}; copy it again"
        )
    file.seek(table)
    entries = [_TABLE.unpack(file.read(_TABLE.size)) for _ in sizes]
    start, streams = file.tell(), {}
    for (key, width), (packed, plain) in zip(sizes.items(), entries, strict=True):
        if plain != header.count * width or start + packed > size:
            raise FormatError(f"{name}: the sizes of the SPZ's streams are wrong; copy it again")
        file.seek(start)
        frame = BytesIO(file.read(packed))
        unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
        with unpacker.stream_reader(frame, closefd=False) as reader:
            streams[key] = _exactly(reader, header.count, width)
            if reader.read(1):
                raise FormatError(f"{name}: a stream of the SPZ has more than its table says; copy it again")
        start += packed
    streams.setdefault("sh", np.zeros((header.count, 0), np.uint8))
    return _unpacked(streams, header)


def _exactly(
    file: "BinaryIO | gzip.GzipFile | zstandard.ZstdDecompressionReader", count: int, width: int
) -> Bytes:
    """The next (count, width) bytes: memory grows as they come. Raises EOFError if there are fewer."""
    rows = np.empty((count, width), np.uint8)  # the system gives pages when they are written
    left = rows.reshape(-1).data
    while left:
        block = file.read(min(len(left), _BLOCK))
        if not block:
            raise EOFError
        left[: len(block)] = block
        left = left[len(block) :]
    return rows


def _unpacked(streams: dict[str, Bytes], header: _Header) -> Splats:
    """All Gaussians, a part at a time."""

    def part(rows: slice) -> dict[str, NDArray[np.float32]]:
        return unpack({name: stream[rows] for name, stream in streams.items()}, header.bits).columns()

    return Splats.made(header.count, min(header.degree, len(REST) - 1), part)
