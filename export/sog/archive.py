"""The files of a SOG, from a folder or a ZIP, with bounds: hostile files end in one line, not in swap."""

import io
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from panolog.scene.errors import FormatError

_DIRECTORY = 2**20  # bytes of a ZIP's directory, at most: a SOG has eight files
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # that the format's viewers read
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, OverflowError)


class _Stream(io.FileIO):
    """A ZIP whose directory takes no more memory than `_DIRECTORY`, whatever it says."""

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes. Raises BadZipFile if they are more than a directory has."""
        if size is not None and size > _DIRECTORY:
            raise zipfile.BadZipFile("its directory does not fit")
        return super().read(size)


@dataclass(frozen=True)
class Folder:
    """Files in a folder."""

    path: Path

    def read(self, name: str, limit: int) -> bytes:
        """A file of at most `limit` bytes. Raises FormatError if there is none, or it is larger."""
        path = self.path / _plain_name(name, self.path)
        if not path.is_file():
            raise FormatError(f"{path}: missing, although meta.json names it; export the model again")
        with path.open("rb") as file:
            data = file.read(limit + 1)
        _check_size(len(data), limit, path)
        return data

    @property
    def size(self) -> int:
        """Bytes of all files directly in it."""
        return sum(path.stat().st_size for path in self.path.iterdir() if path.is_file())


@dataclass(frozen=True)
class Archive:
    """Files in a ZIP."""

    path: Path

    @property
    def size(self) -> int:
        """Bytes of the ZIP."""
        return self.path.stat().st_size

    def read(self, name: str, limit: int) -> bytes:
        """A file of at most `limit` bytes. Raises FormatError if there is none, it is larger, or damaged."""
        try:
            with _Stream(self.path) as stream, zipfile.ZipFile(stream) as directory:
                entry = directory.NameToInfo.get(_plain_name(name, self.path))
        except _DAMAGE as error:
            raise FormatError(f"{self.path}: not a whole .sog ({error}); copy or export it again") from error
        if entry is None:
            raise FormatError(f"{self.path}: has no {name}, which a SOG needs; export the model again")
        _check_size(max(entry.compress_size, entry.file_size), limit, f"{self.path}: {name}")
        try:
            if entry.compress_type not in _METHODS:
                raise zipfile.BadZipFile("compressed in an unknown way")
            with zipfile.ZipFile(self.path) as archive, archive.open(entry) as file:
                return file.read(entry.file_size + 1)  # of a size: without one, zipfile unpacks what comes
        except (*_DAMAGE, OSError) as error:  # the last where an offset is none
            raise FormatError(f"{self.path}: {name} is damaged ({error}); copy or export it again") from error


def _plain_name(name: str, where: Path) -> str:
    """The name of a file directly in a folder. Raises FormatError if it leads elsewhere."""
    if not name or name in (".", "..") or any(sign in name for sign in "/\\\0:"):
        raise FormatError(f"{where}: {name[:80]!r} is not the name of a file in this folder")
    return name


def _check_size(size: int, limit: int, where: Path | str) -> None:
    """Raises FormatError if a file is larger than it may be."""
    if size > limit:
        raise FormatError(
            f"{where}: larger than the {limit:,} bytes that its content can need; export it again"
        )
