"""The files of a SOG, from a folder or a ZIP, read with bounds: hostile files end in one line, not in swap.

The ZIP is read by its central directory, as the format's viewers do: stored or deflated files without ZIP64.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from panolog.scene.errors import FormatError

_END, _ENTRY, _LOCAL = (struct.Struct(text) for text in ("<4s4xHHIIH", "<4s4xHH4xIIIHHH8xI", "<4s22xHH"))
_MOST_FILES = 1024
_TAIL = _END.size + 65_535  # bytes in which the end record is, with its comment
_RATIO = 1032  # of deflate, at most


class _File(NamedTuple):
    deflated: bool
    checksum: int
    packed: int  # bytes
    plain: int  # bytes
    offset: int  # of its local header


@dataclass(frozen=True)
class Folder:
    """Files in a folder."""

    path: Path

    def read(self, name: str, limit: int) -> bytes:
        """A file of at most `limit` bytes. Raises FormatError if there is none, or it is larger."""
        path = self.path / plain_name(name, self.path)
        if not path.is_file():
            raise FormatError(f"{path}: missing, although meta.json names it; export the model again")
        with path.open("rb") as file:
            return _bounded(file.read(limit + 1), limit, path)

    @property
    def size(self) -> int:
        """Bytes of all files directly in it."""
        return sum(path.stat().st_size for path in self.path.iterdir() if path.is_file())


@dataclass(frozen=True)
class Archive:
    """Files in a ZIP."""

    path: Path
    _files: dict[str, _File] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Reads the directory. Raises FormatError if it is no ZIP, or damaged."""
        with self.path.open("rb") as file:
            try:
                self._files.update(_directory(file, self.size))
            except (struct.error, _DamagedError) as error:
                raise FormatError(
                    f"{self.path}: not a whole .sog ({error}); copy or export it again"
                ) from error

    @property
    def size(self) -> int:
        """Bytes of the ZIP."""
        return self.path.stat().st_size

    def read(self, name: str, limit: int) -> bytes:
        """A file of at most `limit` bytes. Raises FormatError if there is none, it is larger, or damaged."""
        if plain_name(name, self.path) not in self._files:
            raise FormatError(f"{self.path}: has no {name}, which a SOG needs; export the model again")
        entry = self._files[name]
        _bounded(b"", limit, f"{self.path}: {name}", claimed=max(entry.packed, entry.plain))
        with self.path.open("rb") as file:
            try:
                return _content(file, entry)
            except (struct.error, zlib.error, _DamagedError) as error:
                raise FormatError(
                    f"{self.path}: {name} is damaged ({error}); copy or export it again"
                ) from error


class _DamagedError(Exception):
    """Why a ZIP cannot be read."""


def plain_name(name: str, where: Path) -> str:
    """The name of a file directly in a folder. Raises FormatError if it leads elsewhere."""
    if not name or name in (".", "..") or any(sign in name for sign in "/\\\0:"):
        raise FormatError(f"{where}: {name[:80]!r} is not the name of a file in this folder")
    return name


def _bounded(data: bytes, limit: int, where: Path | str, claimed: int = 0) -> bytes:
    if max(len(data), claimed) > limit:
        raise FormatError(
            f"{where}: larger than the {limit:,} bytes that its content can need; export it again"
        )
    return data


def _directory(file: BinaryIO, size: int) -> dict[str, _File]:
    """All files by name."""
    start = max(0, size - _TAIL)
    file.seek(start)
    tail = file.read(_TAIL)
    end = tail.rfind(b"PK\5\6")
    if end < 0:
        raise _DamagedError("it has no end record of a ZIP")
    _, _, count, length, offset, _ = _END.unpack_from(tail, end)
    if count > _MOST_FILES or offset + length > size:
        raise _DamagedError("its directory does not fit")
    file.seek(offset)
    listing, at, found = file.read(min(length, size)), 0, {}
    for _ in range(count):
        magic, flags, method, checksum, packed, plain, name, extra, comment, local = _ENTRY.unpack_from(
            listing, at
        )
        if magic != b"PK\1\2" or flags & 1 or method not in (0, 8) or packed > size:
            raise _DamagedError("its directory is damaged, encrypted or compressed in an unknown way")
        if (method == 0 and packed != plain) or plain > packed * _RATIO + 64:
            raise _DamagedError("its directory states sizes that cannot be")
        at += _ENTRY.size
        text = listing[at : at + name].decode("utf-8", "replace")
        found[text] = _File(method == 8, checksum, packed, plain, local)
        at += name + extra + comment
    return found


def _content(file: BinaryIO, entry: _File) -> bytes:
    """The plain bytes of a file."""
    file.seek(entry.offset)
    magic, name, extra = _LOCAL.unpack(file.read(_LOCAL.size))
    if magic != b"PK\3\4":
        raise _DamagedError("it has no header")
    file.seek(name + extra, 1)
    data = file.read(entry.packed)
    if entry.deflated:
        data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, entry.plain + 1)
    if len(data) != entry.plain or zlib.crc32(data) != entry.checksum:
        raise _DamagedError("its bytes are not those that were written")
    return data
