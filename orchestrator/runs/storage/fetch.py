"""Brings a run from a store into a local folder: all of it to resume it, or what a reader needs."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.storage.layout import INFO, Manifest, StoredFile, current
from panolog.orchestrator.runs.storage.lease import holder
from panolog.orchestrator.runs.storage.state import MirrorState, read_state, write_state
from panolog.scene.errors import RunFolderError, StoreError
from panolog.scene.files import atomic, sha256
from panolog.scene.stores.store import Store, open_store
from panolog.scene.stores.url import StoreUrl

_THREADS = 8
_TRIES = 3  # of a file that was replaced in the store while it was fetched
_PATIENCE_S = 60.0  # of commands that only read
Say = Callable[[str], None]


def bring(store: Store, folder: RunFolder, manifest: Manifest | None, say: Say) -> None:
    """Makes a local folder the run that is in a store, to resume it.

    A folder that this run's mirror has copied out last is left as it is: it is as new or newer. One that
    another machine has gone beyond is renamed, not removed. run.json comes last, so that a folder that is
    half there is no run. Args: say, is called with lines for people.
    Raises StoreError if there is no run or it is damaged, RunFolderError if the folder is of something else;
    StoreLostError; OSError if the disk is full.
    """
    kept, url = read_state(folder.mirror), str(store.url)
    if kept is not None and kept.url != url:
        raise RunFolderError(f"{folder.root}: belongs to {kept.url}; choose another folder with --local")
    if folder.info.exists():
        if kept is None and manifest is not None:
            raise RunFolderError(f"{folder.root}: holds a run of its own; choose another folder with --local")
        if manifest is None or (kept is not None and manifest.name in (kept.published, kept.announced)):
            return
        _set_aside(folder, say)
    elif folder.root.is_dir() and kept is None and any(folder.root.iterdir()):
        raise RunFolderError(f"{folder.root}: is not empty and not a run; choose another folder with --local")
    if manifest is None:
        raise StoreError(f"{url}: there is no run yet; start it with `panolog run`")
    folder.root.mkdir(parents=True, exist_ok=True)
    write_state(folder.mirror, MirrorState(url, manifest.name, since=time.time()))
    size = sum(entry.size for entry in manifest.files.values())
    say(f"fetching {len(manifest.files):,} files ({size / 1e6:,.0f} MB) from {url}")
    first = {name: entry for name, entry in manifest.files.items() if name != INFO}
    fetch_files(store, folder.root, first)
    fetch_files(store, folder.root, {INFO: manifest.files[INFO]})


def fetch_files(store: Store, root: Path, files: dict[str, StoredFile]) -> None:
    """Writes files of a run, each atomically and checked. Raises StoreError if one is damaged or gone."""
    with ThreadPoolExecutor(_THREADS, "fetch") as threads:
        for work in [threads.submit(_fetch_one, store, root / name, it) for name, it in files.items()]:
            work.result()


@contextmanager
def viewed(url: StoreUrl, wanted: Callable[[str], bool]) -> Iterator[tuple[Path, bool]]:
    """A part of a run in a store, in a temporary folder, and whether a driver is at work on it.

    Args: wanted, says which files.

    Raises StoreError if there is no run, or it is damaged; StoreLostError.
    """
    store = open_store(url, _PATIENCE_S)
    with tempfile.TemporaryDirectory(prefix="panolog-") as place:
        root = Path(place) / (url.name or "run")
        for tried in range(_TRIES):
            driver, manifest = holder(store), current(store)
            if manifest is None:
                raise StoreError(f"{url}: there is no run; start it with `panolog run`")
            chosen = {name: entry for name, entry in manifest.files.items() if wanted(name)}
            try:
                fetch_files(store, root, chosen)
                break
            except StoreError:
                if tried + 1 == _TRIES:
                    raise
        yield root, bool(driver)


def for_status(name: str) -> bool:
    """Which files `status` and `events` read."""
    return "/" not in name or name.startswith(("prepare/", "partition/plan."))


def for_report(name: str) -> bool:
    """Which files the report needs: of the models that of Stage I alone, and no checkpoints."""
    path = PurePosixPath(name)
    large = path.suffix in (".safetensors", ".ply") and name != "coarse/model.ply"
    return not large and path.parts[0] not in ("web", "scene")


def for_export(name: str) -> bool:
    """Which files an export of the model needs."""
    path, others = PurePosixPath(name), ("web", "scene", "blocks", "round", "repair")
    return path.suffix != ".safetensors" and path.parts[0] not in others


def _fetch_one(store: Store, path: Path, entry: StoredFile) -> None:
    if path.is_file() and path.stat().st_size == entry.size and sha256(path).hex() == entry.sha256:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        for _ in range(_TRIES):  # a truncated answer
            store.get(entry.key, temporary)
            if temporary.stat().st_size == entry.size and sha256(temporary).hex() == entry.sha256:
                break
        else:
            raise StoreError(f"{store.url}/{entry.key}: is not what was stored; its digest differs")
        os.utime(temporary, ns=(entry.modified, entry.modified))


def _set_aside(folder: RunFolder, say: Say) -> None:
    moment = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    aside = folder.root.with_name(f"{folder.root.name}.before-{moment}")
    folder.root.rename(aside)
    say(f"another machine has continued this run: what was here is kept in {aside}")
