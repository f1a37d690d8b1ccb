"""Copies of objects on this machine's disk, shared by its processes and bounded in size.

PANOLOG_STORE_CACHE names the folder, PANOLOG_STORE_CACHE_GIB the bound. The file of an object is named by its
URL and version, so a changed object is another file. What was used least recently is removed first. Room is
reserved under a lock before bytes arrive, so the bound holds for all processes together; an object that has
no room, or a full disk, is read past the cache.
"""

import fcntl
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from panolog.scene.errors import ConfigError
from panolog.scene.files import FULL, SUFFIX, user_folder
from panolog.scene.stores.store import PATIENCE_S, Version, open_store

FOLDER, BOUND = "PANOLOG_STORE_CACHE", "PANOLOG_STORE_CACHE_GIB"
_GIB = 20.0
_LOCKS = 64  # files; two objects may share one
_LEFT_S = 3600.0  # after which a partial file is of a process that was killed


@dataclass(frozen=True)
class Stored:
    """A version of an object."""

    url: str  # of the scene
    name: str  # below it
    version: Version

    def read(self, patience: float = PATIENCE_S) -> bytes:
        """Reads the bytes, from the cache or through it. Args: patience, seconds for which a store may fail.

        Raises StoreError if it is another version by now or gone, StoreLostError if the store fails.
        """
        return Cache.of(os.environ).read(self, patience)


@dataclass(frozen=True)
class Cache:
    """The copies on this machine. Args: folder; bound, bytes."""

    folder: Path
    bound: int

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> "Cache":
        """The cache that the variables describe. Raises ConfigError if the bound is no number."""
        text = environment.get(BOUND, "") or str(_GIB)
        try:
            bound = int(float(text) * 2**30)
        except (ValueError, OverflowError) as error:
            raise ConfigError(f"{BOUND}={text}: write GiB, such as 20") from error
        return cls(cache_folder(environment) / "objects", bound)

    def read(self, stored: Stored, patience: float = PATIENCE_S) -> bytes:
        """The bytes of an object. Raises as `Stored.read`."""
        kept = self.folder / _digest(stored)
        with suppress(FileNotFoundError):
            return self._kept(kept)
        self.folder.mkdir(parents=True, exist_ok=True)
        with _locked(self.folder.parent / f"lock-{int(kept.name[:8], 16) % _LOCKS:02d}"):
            with suppress(FileNotFoundError):  # another process was quicker
                return self._kept(kept)
            return self._fetch(stored, kept, patience)

    def _kept(self, path: Path) -> bytes:
        data = path.read_bytes()
        with suppress(FileNotFoundError):  # it was removed meanwhile
            os.utime(path)
        return data

    def _fetch(self, stored: Stored, kept: Path, patience: float) -> bytes:
        data = _store(stored.url, patience).read_whole(stored.name, stored.version)
        part = self.folder / f"{kept.name}.{os.getpid()}{SUFFIX}"
        try:
            if self._reserve(part, len(data)):
                part.write_bytes(data)
                part.replace(kept)
        except OSError as error:
            if error.errno not in FULL:
                raise
        finally:
            part.unlink(missing_ok=True)
        return data

    def _reserve(self, part: Path, size: int) -> bool:
        """Makes a file of that size, after room for it; False if there is none. Raises OSError."""
        with _locked(self.folder.parent / "lock"):
            found = sorted(_files(self.folder), key=lambda item: item[1].st_mtime_ns)
            total = sum(status.st_size for _, status in found)
            for path, status in found:
                if total + size <= self.bound:
                    break
                if path.suffix != SUFFIX or time.time() - status.st_mtime > _LEFT_S:
                    path.unlink(missing_ok=True)
                    total -= status.st_size
            if total + size > self.bound:
                return False
            with part.open("wb") as file:
                file.truncate(size)
            return True


def cache_folder(environment: Mapping[str, str]) -> Path:
    """Where this machine keeps copies of what is in stores."""
    if given := environment.get(FOLDER, ""):
        return Path(given).absolute()
    own = user_folder("XDG_CACHE_HOME", ".cache")
    return own / "store" if own else Path(tempfile.gettempdir()) / f"panolog-store-{os.getuid()}"


def variables(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables of the cache that are set, for processes on other machines."""
    return {name: environment[name] for name in (FOLDER, BOUND) if environment.get(name)}


_store = lru_cache(maxsize=4)(open_store)


def _digest(stored: Stored) -> str:
    named = f"{stored.url}\0{stored.name}\0{stored.version.size}\0{stored.version.tag}"
    return hashlib.sha256(named.encode()).hexdigest()[:40]


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            with suppress(FileNotFoundError):  # its process has just finished it
                yield Path(entry.path), entry.stat()


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
