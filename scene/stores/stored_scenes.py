"""Scenes in object stores: the driver has an outline of one, workers read whole objects.

An outline is a folder like that of the scene. Its poses, points and lists are whole; its images are sparse
files of the right size that have only their beginning and end, which is all that reading a scene looks at. An
index maps each to its object and version. Who decodes an image gets the bytes of the object instead, from the
machine's cache: `whole` is the one place where that is decided.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path, PurePosixPath

from panolog.scene.errors import StoreError
from panolog.scene.files import atomic, write_bytes
from panolog.scene.stores.cache import Stored, cache_folder
from panolog.scene.stores.store import PATIENCE_S, Store, Version, open_store
from panolog.scene.stores.url import parse_url

SUFFIX = ".outline"  # of the folder's name
INDEX = ".objects.json"
_IMAGES = ("images", "imgs", "masks", "skymasks", "depths")  # folders of large files
_MODEL = "sparse"  # the folder of small ones
_SMALL = 16 * 2**20  # bytes of a file next to these folders that is taken along
_HEADS, _TAIL = (16_384, 262_144), 4_096  # bytes of an image: metadata may come before its size
_THREADS = 16
_OLD_S = 7 * 86_400.0  # without use, after which the outline of an earlier version of a scene is removed
_KNOWN: dict[Path, Stored] = {}  # files of outlines that are on another machine


def outline(url: str, sound: Callable[[Path], bool]) -> Path:
    """Makes, or completes, the outline of the scene at a URL. Returns its folder.

    Args: sound, whether a file looks like a whole image from its two ends; of one that does not all is read.
    Raises StoreError if there is no scene or no access, StoreLostError if the store fails.
    """
    store = open_store(parse_url(url))
    objects = {name: it for name, it in store.list().items() if _belongs(name, it)}
    if not any(name.startswith(f"{_MODEL}/") for name in objects):
        raise StoreError(f"{store.url}: there is no COLMAP model in sparse/0; give the URL of a scene")
    root = _folder(str(store.url), objects)
    root.mkdir(parents=True, exist_ok=True)
    missing = [name for name, version in objects.items() if not _complete(root / name, version)]
    with ThreadPoolExecutor(_THREADS, "outline") as threads:
        for work in [
            threads.submit(_draw, store, name, objects[name], root / name, sound) for name in missing
        ]:
            work.result()
    content = {"url": str(store.url), "objects": {name: asdict(it) for name, it in sorted(objects.items())}}
    write_bytes(root / INDEX, json.dumps(content).encode())
    _remove_older(root)
    return root


def url_of(root: Path) -> str | None:
    """The URL of the scene that a folder outlines; None if it is a plain scene."""
    return _index(root)[0] if root.name.endswith(SUFFIX) else None


def local_folder(scene: str) -> Path:
    """Where this machine has a scene, given as run.json names it: that folder, or the outline of a URL."""
    found = sorted(_outlines().glob(f"{_key(scene)}-*{SUFFIX}"), key=lambda path: path.stat().st_mtime)
    return found[-1] if found else Path(scene)


def made_here(root: Path) -> bool:
    """Whether a folder is an outline that this machine has made: what it names may be fetched for anyone."""
    return root.name.endswith(SUFFIX) and root.parent == _outlines()


def stored_of(path: Path) -> Stored | None:
    """The object that a file outlines; None if it is a plain file."""
    if path in _KNOWN:
        return _KNOWN[path]
    for parent in path.parents:
        if parent.name.endswith(SUFFIX):
            url, objects = _index(parent)
            version = objects.get(name := path.relative_to(parent).as_posix())
            return None if url is None or version is None else Stored(url, name, version)
    return None


def remember(path: Path, stored: Stored) -> None:
    """Makes `whole` read an object where this process opens a path of another machine."""
    _KNOWN[path] = stored


def whole(path: Path, patience: float = PATIENCE_S) -> bytes | None:
    """The bytes of the object that a file outlines; None if it is a plain file. As `Stored.read`."""
    stored = stored_of(path)
    return None if stored is None else stored.read(patience)


def _belongs(name: str, version: Version) -> bool:
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or name.startswith("/") or parts[0].startswith(".") or "\0" in name:
        return False
    return parts[0] in (*_IMAGES, _MODEL) or (len(parts) == 1 and version.size <= _SMALL)


def _key(url: str) -> str:
    return hashlib.sha256(url.encode()).hexdigest()[:16]


def _folder(url: str, objects: Mapping[str, Version]) -> Path:
    """A folder for these versions: that of another version is not changed while a run reads it."""
    listed = json.dumps({name: [it.size, it.tag] for name, it in sorted(objects.items())})
    name = f"{_key(url)}-{hashlib.sha256(listed.encode()).hexdigest()[:16]}{SUFFIX}"
    return _outlines() / name


def _outlines() -> Path:
    return cache_folder(os.environ) / "scenes"


def _complete(path: Path, version: Version) -> bool:
    """Whether a file of an outline is there: it appears when it is finished."""
    with suppress(FileNotFoundError):
        return path.stat().st_size == version.size
    return False


def _draw(store: Store, name: str, version: Version, path: Path, sound: Callable[[Path], bool]) -> None:
    """Writes one file of an outline."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = PurePosixPath(name).parts[0] in _IMAGES
    for head in _HEADS if image else ():
        if head + _TAIL < version.size:
            with atomic(path) as temporary:
                _write_ends(temporary, store, name, version, head)
                os.utime(temporary, (version.modified, version.modified))
            if sound(path):
                return
            path.unlink()
    with atomic(path) as temporary:
        temporary.write_bytes(store.read_whole(name, version))
        os.utime(temporary, (version.modified, version.modified))


def _write_ends(path: Path, store: Store, name: str, version: Version, head: int) -> None:
    first, last = store.read(name, 0, head), store.read(name, version.size - _TAIL, version.size)
    if first is None or last is None or (len(first), len(last)) != (head, _TAIL):
        raise StoreError(f"{store.url}/{name}: has changed while the scene was read; try again")
    with path.open("wb") as file:
        file.write(first)
        file.seek(version.size - _TAIL)
        file.write(last)


def _index(root: Path) -> tuple[str | None, Mapping[str, Version]]:
    """The URL and the objects of an outline; none if it is not finished."""
    try:
        changed = (root / INDEX).stat().st_mtime_ns
    except FileNotFoundError:
        return None, {}
    return _read_index(root, changed)


@lru_cache(maxsize=4)
def _read_index(root: Path, _changed: int) -> tuple[str, Mapping[str, Version]]:
    content = json.loads((root / INDEX).read_bytes())
    return content["url"], {name: Version(**fields) for name, fields in content["objects"].items()}


def _remove_older(root: Path) -> None:
    """Removes outlines of earlier versions of a scene that no run has used for long."""
    os.utime(root)
    for other in root.parent.glob(f"{root.name.partition('-')[0]}-*{SUFFIX}"):
        with suppress(FileNotFoundError):
            if other != root and time.time() - other.stat().st_mtime > _OLD_S:
                shutil.rmtree(other, ignore_errors=True)
