"""Which runs are below the dashboard's folder, their ids, and how their files are opened.

A client never sends a path: it sends an id, and only what was found here has one. What is found may still be
hostile: a run folder from elsewhere can hold links, pipes and devices under the names of files.
"""

import os
import stat
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

from panolog.orchestrator.runs.folder import RunFolder
from panolog.scene.errors import InputError

_DEPTH = 4  # folders between the dashboard's and a run
_FOLDERS = 20_000  # looked into at most
_RUNS = 2_000  # found at most
_PLAIN = ("run.json", "run.db", "run.db-journal", "lock")  # must be plain files where they exist


@dataclass(frozen=True)
class RunEntry:
    """A run that was found below `root`."""

    root: Path  # the dashboard's folder, without links
    path: str  # of the run, relative to root, as the file system has it

    @property
    def id(self) -> str:
        """16 hex digits that name the run in URLs."""
        return sha256(os.fsencode(self.path)).hexdigest()[:16]

    @property
    def name(self) -> str:
        """The path as text that every encoding can represent."""
        return os.fsencode(self.path).decode(errors="replace")

    @property
    def folder(self) -> RunFolder:
        """Its files."""
        return RunFolder(self.root / self.path)


def discover(root: Path) -> dict[str, RunEntry]:
    """The runs below `root` by id, `root` included. Links are not followed, runs not searched for others."""
    found: dict[str, RunEntry] = {}
    waiting, seen = deque([(root, 0)]), 0
    while waiting and seen < _FOLDERS and len(found) < _RUNS:
        folder, depth = waiting.popleft()
        seen += 1
        folders, is_run = _scan(folder)
        if is_run:
            entry = RunEntry(root, folder.relative_to(root).as_posix())
            found[entry.id] = entry
        elif depth < _DEPTH:
            waiting.extend((child, depth + 1) for child in folders)
    return found


def _scan(folder: Path) -> tuple[list[Path], bool]:
    """The folders in a folder, and whether it is a run. One that cannot be read is empty."""
    folders, is_run = [], False
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                is_run = is_run or (entry.name == "run.json" and entry.is_file(follow_symlinks=False))
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                    folders.append(folder / entry.name)
    except OSError:
        return [], False
    return sorted(folders), is_run


def require_plain(entry: RunEntry) -> None:
    """Makes sure that the files of a run that are opened by their paths are plain files in place.

    Raises InputError if the run is gone, has moved out of the dashboard's folder, or has links or anything
    but plain files where its own files should be.
    """
    root = entry.folder.root
    try:
        if root.resolve(strict=True) != root:
            raise InputError(f"{entry.name}: is reached through a link")
        for name in _PLAIN:
            mode = _mode(root / name)
            if mode is not None and not stat.S_ISREG(mode):
                raise InputError(f"{entry.name}: {name} is not a plain file")
        control = _mode(entry.folder.control)
        if control is not None and not stat.S_ISDIR(control):
            raise InputError(f"{entry.name}: control is not a folder")
        if _mode(entry.folder.info) is None:
            raise InputError(f"{entry.name}: is no longer a run, it has no run.json")
    except OSError as error:
        raise InputError(f"{entry.name}: {error.strerror}") from error


def _mode(path: Path) -> int | None:
    """The mode of a path, links not followed; None if there is nothing."""
    try:
        return path.lstat().st_mode
    except FileNotFoundError:
        return None


@contextmanager
def opened(path: Path, below: Path) -> Iterator[BinaryIO]:
    """A plain file to read, if it really is below a folder. Raises as `open_below`."""
    with os.fdopen(open_below(path, below), "rb") as file:
        yield file


def open_below(path: Path, below: Path) -> int:
    """A descriptor of a plain file that really is below a folder, whatever links are on the way.

    The path is checked after the file was opened, so that it cannot be exchanged in between.
    Raises InputError if there is no such file there.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        raise InputError(f"{path.name}: cannot be read") from error
    try:
        real = by_handle(handle).readlink()
        if not (stat.S_ISREG(os.fstat(handle).st_mode) and real.is_relative_to(below.resolve())):
            raise InputError(f"{path.name}: is not a plain file of the run")
    except (OSError, InputError):
        os.close(handle)
        raise
    return handle


def read_below(path: Path, below: Path, most: int) -> bytes:
    """The bytes of a plain file below a folder. Raises InputError as `open_below`, or beyond `most` bytes."""
    with opened(path, below) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise InputError(f"{path.name}: has more than {most:,} bytes")
    return content


def by_handle(handle: int) -> Path:
    """A path that opens the file of a descriptor again, whatever has its name by now."""
    return Path(f"/proc/self/fd/{handle}")
