"""What every importer returns: posed panoramas and a cloud, in our convention."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import InputError
from panolog.scene.new_scene import PosedImage

_SUFFIXES = (".jpg", ".jpeg", ".png", ".JPG", ".JPEG", ".PNG", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """What a format holds."""

    images: Sequence[PosedImage]
    points: NDArray[np.float64]  # (P, 3) world units
    colors: NDArray[np.uint8] | None  # (P, 3) RGB; None where the format has none: the panoramas then tell
    train: Sequence[str] = ()  # stems, where the format has a split
    test: Sequence[str] = ()
    notes: Sequence[str] = ()  # one line each, for people: what was left out


@dataclass(frozen=True)
class ImportSource:
    """What the user gave."""

    path: Path  # a file or a folder
    images: Path | None = None  # where the panoramas are, if not where the format says
    points: Path | None = None  # a PLY, if the format has no points or other ones are wanted

    @property
    def folder(self) -> Path:
        """The folder that `path` is, or is in."""
        return self.path if self.path.is_dir() else self.path.parent

    def first(self, *names: str) -> Path | None:
        """`path` itself if it is a file of one of these names, else the first that is in the folder."""
        if self.path.is_file():
            return self.path if self.path.name in {Path(name).name for name in names} else None
        return next((self.path / name for name in names if (self.path / name).is_file()), None)


def find_panorama(where: str, folders: Sequence[Path], name: str) -> tuple[str, Path]:
    """(name in the scene, file) of the panorama that a format calls `name`.

    Looks in `folders`, in order, for the name, for its last part, and for both with another extension:
    programs write names without one, or that of the original. Folders in the name stay in it.

    Raises:
        InputError: the name leaves the folder, or no file belongs to it; `where` says which field named it.
    """
    clean = PurePosixPath(name.replace("\\", "/"))
    if clean.is_absolute():
        clean = PurePosixPath(clean.name)
    if ".." in clean.parts or not clean.name or "\0" in name or len(name) > 1024:
        raise InputError(f"{where}: the image name {name[:80]!r} is no path inside the image folder")
    try:
        for folder in folders:
            for candidate in _spellings(clean):
                if (folder / candidate).is_file():
                    return str(candidate), folder / candidate
    except (ValueError, OSError) as error:  # a name that no file system can have
        raise InputError(f"{where}: the image name {name[:80]!r} cannot be a file's") from error
    looked = " or ".join(str(folder) for folder in folders)
    raise InputError(f"{where}: {name[:80]} is not in {looked}; say where the panoramas are with --images")


def _spellings(name: PurePosixPath) -> Iterator[PurePosixPath]:
    """The paths that a program may mean by a name, the likeliest first."""
    for path in dict.fromkeys((name, PurePosixPath(name.name))):
        yield path
        yield from (path.with_name(path.name + suffix) for suffix in _SUFFIXES)
        yield from (path.with_suffix(suffix) for suffix in _SUFFIXES if path.suffix)


def image_folders(source: ImportSource, *names: str) -> list[Path]:
    """Where to look for panoramas: what the user gave, else those of `names` in the folder, and it."""
    if source.images is not None:
        return [source.images]
    return [*(source.folder / name for name in names if (source.folder / name).is_dir()), source.folder]


def read_stems(path: Path) -> list[str]:
    """The lines of a split file without the extensions of images; empty without the file.

    Raises:
        InputError: the file is not text, or too large to be one of names.
    """
    if not path.is_file():
        return []
    if path.stat().st_size > 2**26:
        raise InputError(f"{path}: too large to be a list of images")
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8; save it so") from error
    names = [PurePosixPath(line.strip().replace("\\", "/")) for line in lines if line.strip()]
    return [str(name.with_suffix("")) if name.suffix in _SUFFIXES else str(name) for name in names]
