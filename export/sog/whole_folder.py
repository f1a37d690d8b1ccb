"""Folders of a SOG that appear whole: written under another name, then renamed.

A folder that this package wrote is replaced; anything else at its place stays, and is an error.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from panolog.scene.errors import FormatError
from panolog.scene.files import atomic_folder

META, INDEX = "meta.json", "lod-meta.json"  # of a SOG, and of one that streams
GENERATOR = "panolog"
IMAGES = ("means_l", "means_u", "scales", "quats", "sh0", "shN_centroids", "shN_labels")
_CHUNK = r"\d+_\d+|env"
_OWN = re.compile(rf"(?:(?:{_CHUNK})/)?(?:meta\.json|(?:{'|'.join(IMAGES)})\.webp)|{_CHUNK}|lod-meta\.json")
_HEAD = 200  # bytes of an index in which the name of its generator stands


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yields an empty temporary folder, which becomes `folder` when the block ends well.

    Raises FormatError: there is something that this package has not written; OSError: the folder above is
    missing or cannot be written.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100  # without following links, so that `..` has a name
    _check(folder)
    with atomic_folder(folder) as temporary:
        yield temporary
        _check(folder)


def save(folder: Path, files: dict[str, bytes]) -> None:
    """Writes files into a folder. Raises OSError."""
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)


def _check(folder: Path) -> None:
    """Raises FormatError if there is anything that this package has not written."""
    if not folder.exists() and not folder.is_symlink():
        return
    foreign = None if folder.is_dir() and not folder.is_symlink() else folder
    names = [] if foreign else [(path, path.relative_to(folder).as_posix()) for path in folder.rglob("*")]
    foreign = next((path for path, name in names if path.is_symlink() or not _OWN.fullmatch(name)), foreign)
    indices = [folder / name for name in (INDEX, META) if (folder / name).is_file()]
    if not foreign and names and not any(_written_here(index) for index in indices):
        foreign = folder
    if foreign:
        raise FormatError(
            f"{foreign}: not written as a SOG by panolog, so it is not replaced; choose another folder"
        )


def _written_here(index: Path) -> bool:
    with index.open("rb") as file:
        return f'"generator":"{GENERATOR}"'.encode() in file.read(_HEAD)
