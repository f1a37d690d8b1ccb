"""Which runs are below the dashboard's folder, and their ids.

A client never sends a path: it sends an id, and only what was found here has one. What is found may still be
hostile: a run folder from elsewhere can hold links, pipes and devices under the names of files.
"""

import os
from collections import deque
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from panolog.orchestrator.runs import folder as run_folder
from panolog.orchestrator.runs.folder import RunFolder
from panolog.scene.errors import InputError

_DEPTH = 4  # folders between the dashboard's and a run
_FOLDERS = 20_000  # looked into at most
_RUNS = 2_000  # found at most


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
        """The files of the run."""
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
        run_folder.require_plain(entry.folder)
        if not entry.folder.info.exists():
            raise InputError(f"{entry.name}: is no longer a run, it has no run.json")
    except OSError as error:
        raise InputError(f"{entry.name}: {error.strerror}") from error
