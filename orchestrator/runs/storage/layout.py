"""What of a run is in a store: objects, manifests that name them, and one pointer to the current manifest.

    URL/.panolog/objects/NAME/…           versions of the run's files; each is stored once and never changed
    URL/.panolog/manifests/…              which object is which file, with sizes and digests; compressed JSON
    URL/.panolog/pointers/NUMBER.json     names a manifest; put last, by the driver whose lease has its number
    URL/.panolog/leases/NUMBER.json       who writes the run, and until when
    URL/NAME                              copies of the results of a run that is done, under their own names

Drivers only add to it: nothing is removed but by `panolog clean URL`, and by the driver of a run that is
refused before it has made anything. Only the pointer, the lease and the copies of results are replaced. The
pointer of the highest number counts: what it leads to is whole at any moment, and a driver that has been
replaced without knowing it replaces nothing.
"""

import json
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from panolog.scene.errors import StoreError
from panolog.scene.stores.store import Store

ROOT = ".panolog"
OBJECTS, MANIFESTS, POINTERS, LEASES = (
    f"{ROOT}/{name}" for name in ("objects", "manifests", "pointers", "leases")
)
DATABASE, INFO = "run.db", "run.json"
_TRIES = 5  # of a pointer whose manifest is replaced while it is read
_MOST = 2**30  # bytes of a manifest, uncompressed
# What is not copied out: it is of this machine, or a resumed driver makes it anew.
_LOCAL = ("store", "control", "lock", "supervisor", "driver", "tensorboard", DATABASE, f"{DATABASE}-journal")
_REMADE = ("initial.ply", "snapshot.safetensors")
_MADE = ("blocks", "coarse", "district", "round", "repair", "union", "scene")  # folders
_WORK = (*_MADE, "prepare", "follower", DATABASE)  # what a run needs only to be resumed: no result


@dataclass(frozen=True)
class StoredFile:
    key: str  # of its object, below the URL
    size: int  # bytes
    sha256: str
    modified: int  # ns since the epoch


@dataclass(frozen=True)
class Manifest:
    """A run at one moment."""

    name: str  # of the manifest's own object
    files: Mapping[str, StoredFile]  # by their names in the run folder

    @property
    def time(self) -> float:
        """When it was made, in seconds since the epoch; 0 if its name does not say."""
        moment = PurePosixPath(self.name).name.partition("-")[0]
        with suppress(ValueError):
            return int(moment, 16) / 1e9
        return 0.0

    def pack(self) -> bytes:
        files = {name: asdict(entry) for name, entry in sorted(self.files.items())}
        return zlib.compress(json.dumps({"format": 1, "files": files}).encode())


def mirrored(name: str) -> bool:
    """Whether a file of a run folder is copied out. Args: name, relative to the folder."""
    path = PurePosixPath(name)
    shard = path.parts[:2] == ("eval", "shards") and path.suffix == ".ply"
    return not (path.parts[0] in _LOCAL or path.name in _REMADE or path.suffix == ".part" or shard)


def is_result(name: str) -> bool:
    """Whether a file of a run is for its user, and not only for what resumes it."""
    return PurePosixPath(name).parts[0] not in _WORK


def is_work(name: str) -> bool:
    """Whether a file is of what takes time to make: a run that has any is never withdrawn."""
    first, *rest = PurePosixPath(name).parts
    return first in _MADE or first == "scene.sfm" or (first == "prepare" and rest[:1] == ["masks"])


def number_of(name: str) -> int:
    """The number of a pointer or a lease; 0 of anything else."""
    stem = PurePosixPath(name).stem
    return int(stem) if stem.isdecimal() else 0


def newest(store: Store, folder: str) -> str | None:
    """The pointer or the lease with the highest number. Raises as `Store`."""
    names = [name for name in store.list(folder) if number_of(name)]
    return max(names, key=number_of, default=None)


def numbered(folder: str, number: int) -> str:
    """The name of a pointer or a lease."""
    return f"{folder}/{number:06d}.json"


def put_pointer(store: Store, number: int, manifest: Manifest, packed: bytes) -> None:
    """Makes a manifest the current one. Args: number, of the driver's lease; packed, the manifest's bytes."""
    content = {"format": 1, "manifest": manifest.name, "sha256": sha256(packed).hexdigest()}
    store.write(numbered(POINTERS, number), json.dumps(content).encode())


def current(store: Store) -> Manifest | None:
    """The manifest that the pointer names; None if there is no run.

    Raises as `Store`; StoreError if it is missing or damaged.
    """
    for _ in range(_TRIES):
        pointer = newest(store, POINTERS)
        if pointer is None:
            return None
        content = store.read(pointer)
        if content is None:  # a new driver has put its own
            continue
        named = _parsed(store, pointer, content)
        packed = store.read(str(named.get("manifest")))
        if packed is not None and sha256(packed).hexdigest() == named.get("sha256"):
            return _unpacked(store, str(named["manifest"]), packed)
    raise StoreError(
        f"{store.url}/{POINTERS}: names a manifest that is missing or damaged; resume an older copy"
    )


def read_manifest(store: Store, name: str) -> Manifest:
    """A manifest, the current one or one before. Raises as `Store`; StoreError if it is gone or damaged."""
    packed = store.read(name)
    if packed is None:
        raise StoreError(f"{store.url}/{name}: is gone")
    return _unpacked(store, name, packed)


def _unpacked(store: Store, name: str, packed: bytes) -> Manifest:
    unpack = zlib.decompressobj()
    try:
        content = _parsed(store, name, unpack.decompress(packed, _MOST))
        files = {str(file): StoredFile(**fields) for file, fields in content["files"].items()}
    except (zlib.error, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{store.url}/{name}: is no manifest of this PanoLOG ({error!r})") from error
    for file in files:
        if (
            (not mirrored(file) and file != DATABASE)
            or PurePosixPath(file).is_absolute()
            or ".." in Path(file).parts
        ):
            raise StoreError(f"{store.url}/{name}: names {file!r}, which is no file of a run")
    return Manifest(name, files)


def _parsed(store: Store, name: str, content: bytes) -> dict[str, Any]:
    try:
        found = json.loads(content)
    except ValueError as error:
        raise StoreError(f"{store.url}/{name}: is not JSON ({error})") from error
    if not isinstance(found, dict) or found.get("format") != 1:
        raise StoreError(f"{store.url}/{name}: is not of this PanoLOG's format")
    return found
