"""Files that appear whole or not at all: written under a temporary name, flushed, then renamed.

`Locate` maps a path to where this machine has the file: on a cluster the path may be another machine's.
"""

import errno
import hashlib
import os
import re
import secrets
import shutil
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import TypeAlias

StrPath: TypeAlias = str | os.PathLike[str]  # what users may give where a path is needed
SUFFIX = ".part"
FULL = (errno.ENOSPC, errno.EDQUOT)  # errors of a disk without room
_NUMBER = re.compile("0*([0-9]+)")
_CHUNK = 2**20  # bytes hashed at a time
Locate = Callable[[Path], Path]  # a path as the run has it -> where the file is on this machine


def stem_of(name: str) -> str:
    """The name of an image file without its extension. A number after a dot, as in `a.1`, is none."""
    path = Path(name)
    return str(path if path.suffix[1:].isdecimal() else path.with_suffix(""))


def spellings(name: str) -> tuple[str, ...]:
    """A name as it is, and with its accents composed (NFC) and apart (NFD), as file systems have it."""
    return tuple(dict.fromkeys([name, *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]))


def file_of(folder: Path, name: str) -> Path:
    """The file of a name in a folder, also if its accents are spelled otherwise; else FOLDER/NAME."""
    found = (folder / spelled for spelled in spellings(name))
    return next((path for path in found if path.is_file()), folder / name)


def some_of(names: Sequence[str], kind: str = "file") -> str:
    """Names of a kind of things, for a message of one line: how many there are, and the first three."""
    more = ", …" if len(names) > 3 else ""
    return f"{len(names):,} {kind}{'s' if len(names) > 1 else ''} ({', '.join(names[:3])}{more})"


def natural_key(name: str) -> tuple[str, str]:
    """Sorts names in the order in which cameras count: by the value of a number, so that 2 is before 10.

    Names whose numbers have leading zeros, all of one length, have the same order as in plain sorting.
    """
    return _NUMBER.sub(lambda found: f"{len(found[1]):04d}{found[1]}", name), name


def here(path: Path) -> Path:
    """The `Locate` of the machine that has all files."""
    return path


def user_folder(variable: str, default: str) -> Path | None:
    """PanoLOG's folder in one of the user's, which a variable of XDG names; by default below the home.

    None for a user without variable, HOME and entry in the system's list, as in containers.
    """
    if root := os.environ.get(variable):
        return Path(root) / "panolog"
    try:
        return Path.home() / default / "panolog"
    except RuntimeError:
        return None


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yields a temporary path in the folder of `path`; when the block ends well, its file becomes `path`.

    The bytes are on the disk before the name is, so neither a kill nor a power cut leaves half a file under
    `path`. If the block raises, what is at `path` stays.

    Raises OSError: the folder is missing or cannot be written, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}{SUFFIX}")
    try:
        with _named(path, temporary):
            yield temporary
            publish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yields an empty folder next to `folder`, which takes its place when the block ends well.

    Its files are on the disk before its name is. What was there is removed; a power cut between the two
    renames leaves it as `.NAME.….part`. If the block raises, it stays.

    Raises OSError: the folder above is missing or cannot be written, or the disk is full.
    """
    new, old = (folder.with_name(f".{folder.name}.{secrets.token_hex(4)}{SUFFIX}") for _ in range(2))
    with _named(folder, new):
        new.mkdir()
    try:
        with _named(folder, new):
            yield new
            for written in (*new.rglob("*"), new):
                flush(written)
        if folder.exists():
            folder.rename(old)
        try:
            new.rename(folder)
        except OSError:
            if old.exists():
                old.rename(folder)
            raise
        flush(folder.parent)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _named(path: Path, temporary: Path) -> Iterator[None]:
    """Names what is written in the error of a full disk, which names nothing, and of its temporary file."""
    try:
        yield
    except OSError as error:
        if error.errno in (*FULL, errno.EFBIG) or str(error.filename) == str(temporary):
            error.filename = str(path)
        raise


def publish(source: Path, path: Path) -> None:
    """Moves a finished file of the same folder to `path`. Raises OSError as `atomic` does.

    A device or a pipe, such as /dev/null, gets the bytes and stays what it is.
    """
    flush(source)
    if path.exists() and not (path.is_file() or path.is_dir()):
        with source.open("rb") as file, path.open("wb") as special:
            shutil.copyfileobj(file, special)
        source.unlink()
        return
    source.replace(path)
    flush(path.parent)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path` atomically. Raises OSError as `atomic` does."""
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def remove_partial(folder: Path) -> None:
    """Removes what killed writers left below `folder`: only for its single writer, before it writes."""
    for leftover in list(folder.rglob(f".*{SUFFIX}")):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)  # its writer may do the same


def flush(path: Path) -> None:
    """Waits until a file's bytes, or a folder's names, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256(path: Path) -> bytes:
    """The SHA-256 of a file of any size. Raises OSError if it cannot be read."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            found.update(chunk)
    return found.digest()


def write_all(file: FileIO, content: memoryview) -> None:
    """Writes bytes where an unbuffered file is. Raises OSError if the disk is full."""
    left = content
    while left:
        left = left[file.write(left) :]


def read_at(file: FileIO, offset: int, into: memoryview) -> None:
    """Reads the bytes from `offset` on, in any thread.

    Raises OSError if they cannot be read, EOFError if the file ends before.
    """
    left = into
    while left:
        if not (count := os.preadv(file.fileno(), [left], offset)):
            raise EOFError(f"{len(left)} bytes from {offset} on are missing")
        left, offset = left[count:], offset + count
