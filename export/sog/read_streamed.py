"""Streamed SOG read: one level of detail of all leaves, by any writer. `streamed` has what the index says."""

import json
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from panolog.export.sog.archive import Folder, plain_name
from panolog.export.sog.folder import INDEX
from panolog.export.sog.read import read_sog
from panolog.export.sog.write import MOST
from panolog.export.splats import Splats
from panolog.scene.errors import FormatError
from panolog.scene.files import StrPath

_INDEX_BYTES = 2**24  # of an index: about 100,000 leaves with all levels
_MOST_LEVELS = 64
_KEYS = ("file", "offset", "count")  # of a level of a leaf


class _Part(NamedTuple):
    """Where some Gaussians of a leaf are."""

    file: int
    offset: int
    length: int


def read_streamed(path: StrPath, level: int = 0) -> Splats:
    """The Gaussians of one level, file after file; what is in `env/` is not among them: `read_sog` reads it.

    Args: path of a folder with lod-meta.json, or of this file; level, 0 is the finest one.
    Raises FormatError: it is missing or damaged, has no Gaussians of this level, or more than `MOST`;
    OSError: it cannot be read.
    """
    path = Path(path)
    index = path if path.suffix.lower() == ".json" else path / INDEX
    meta = _index(index)
    names = meta.get("filenames")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FormatError(f"{index}: has no list of filenames; export the model again")
    parts = sorted(_parts(meta.get("tree"), level, len(names), index))
    if not 0 < sum(part.length for part in parts) <= MOST:
        raise FormatError(f"{index}: has not 1 to {MOST:,} Gaussians on level {level}; give another level")
    found = []
    for file, places in groupby(parts, key=lambda part: part.file):
        whole = read_sog(_beside(index, names[file]))
        for place in places:
            if place.offset + place.length > len(whole):
                raise FormatError(
                    f"{index}: {names[file]} has fewer Gaussians than are named; export it again"
                )
            found.append(whole.select(slice(place.offset, place.offset + place.length)))
    if len({part.degree for part in found}) > 1:
        raise FormatError(f"{index}: its files are of different SH degrees; export the model again")
    return Splats.joined(found)


def _index(path: Path) -> dict[str, Any]:
    """The index, of version 1 or from before there were versions."""
    if not path.is_file():
        raise FormatError(f"{path}: there is no such index; give a folder with {INDEX}, or this file")
    try:
        meta = json.loads(Folder(path.parent).read(path.name, _INDEX_BYTES))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path}: is no JSON ({str(error)[:60]}); export the model again") from error
    if not isinstance(meta, dict) or meta.get("version", 1) != 1:
        raise FormatError(f"{path}: is no index of version 1; export the model with a current program")
    return meta


def _parts(tree: object, level: int, files: int, where: Path) -> list[_Part]:
    """Where all leaves have their Gaussians of a level."""
    found, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        children, lods = (
            (node.get("children", []), node.get("lods", {})) if isinstance(node, dict) else (None, None)
        )
        if not isinstance(children, list) or not isinstance(lods, dict) or len(lods) > _MOST_LEVELS:
            raise FormatError(f"{where}: its tree has a node of an unknown form; export the model again")
        waiting.extend(children)
        if (place := lods.get(str(level))) is None:
            continue
        numbers: list[Any] = [place.get(name) for name in _KEYS] if isinstance(place, dict) else []
        if len(numbers) != 3 or not all(type(number) is int and 0 <= number <= MOST for number in numbers):
            raise FormatError(f"{where}: a leaf has no whole file, offset and count; export the model again")
        part = _Part(*numbers)
        if part.file >= files:
            raise FormatError(f"{where}: a leaf is in file {part.file} of {files}; export the model again")
        if part.length:
            found.append(part)
    return found


def _beside(index: Path, name: str) -> Path:
    """A file below the folder of an index. Raises FormatError if its name leads elsewhere."""
    path = index.parent
    for part in name.split("/"):
        path = path / plain_name(part, index)
    return path
