"""`panolog clean URL`: the only thing that removes of a run in a store, which drivers only add to.

What stays is what the last manifests name, and whatever is not below URL/.panolog, such as results.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath

from panolog.orchestrator.runs.retention.clean import Cleaned
from panolog.orchestrator.runs.retention.survey import Kind, Removal, Survey
from panolog.orchestrator.runs.storage import lease
from panolog.orchestrator.runs.storage.layout import (
    MANIFESTS,
    OBJECTS,
    POINTERS,
    Manifest,
    current,
    newest,
    read_manifest,
)
from panolog.scene.errors import PanologError, RunLockedError, StoreError, in_one_line
from panolog.scene.stores.store import Store, open_store
from panolog.scene.stores.url import StoreUrl

_PATIENCE_S = 60.0  # of one request
_NOBODY = Path("/dev/null/clean")  # stands for the folder of the run: no driver's, so that none is waited for


def survey_stores(urls: Sequence[StoreUrl], keep: int, older: float | None) -> Cleaned:
    """What may be removed of runs in stores. Args: keep, manifests that stay; older, as `survey.Wanted`."""
    return Cleaned(tuple(_surveyed(url, keep, older) for url in urls), dry=True)


def clean_stores(found: Cleaned, keep: int) -> Cleaned:
    """Removes what was found, under the lease of each run, as far as it is still superseded."""
    return Cleaned(tuple(_cleaned(run, keep) for run in found.runs), dry=False)


def _surveyed(url: StoreUrl, keep: int, older: float | None) -> Survey:
    try:
        store = open_store(url, _PATIENCE_S)
        if driver := lease.holder(store):
            return Survey(url, skipped=f"{driver} is at work on it")
        manifest = _current(store)
        since = time.time() - manifest.time
        if older is not None and since < older:
            return Survey(url, skipped=f"it was written {since / 86_400:.1f} days ago")
        return Survey(url, tuple(_superseded(store, manifest, keep)))
    except PanologError as error:
        return Survey(url, skipped=in_one_line(error), failed=True)


def _cleaned(found: Survey, keep: int) -> Survey:
    if found.skipped or not found.removals:
        return found
    removed: list[Removal] = []
    try:
        store = open_store(str(found.root), _PATIENCE_S)
        own = lease.take(store, _NOBODY, force=False)
        try:
            shown = {removal.path for removal in found.removals}
            for removal in _superseded(store, _current(store), keep):
                if removal.path in shown:
                    store.remove(str(removal.path))
                    removed.append(removal)
        finally:
            own.release()
        return replace(found, removals=tuple(removed))
    except RunLockedError as error:
        return Survey(found.root, skipped=in_one_line(error))
    except PanologError as error:
        return Survey(found.root, tuple(removed), in_one_line(error), failed=True)


def _current(store: Store) -> Manifest:
    if (manifest := current(store)) is None:
        raise StoreError(f"{store.url}: there is no run")
    return manifest


def _superseded(store: Store, manifest: Manifest, keep: int) -> Iterator[Removal]:
    """The objects that none of the last manifests needs."""
    folders = (OBJECTS, MANIFESTS, POINTERS)  # leases are a few bytes, and decide whose the run is
    every = {name: version for folder in folders for name, version in store.list(folder).items()}
    stays = {manifest.name, newest(store, POINTERS)}
    stays |= {entry.key for entry in manifest.files.values()}
    before = [name for name in sorted(every) if name.startswith(MANIFESTS) and name < manifest.name]
    for name in before[len(before) - min(keep - 1, len(before)) :]:
        stays.add(name)
        with suppress(StoreError):  # damaged: it stays, and what it named cannot be known
            stays |= {entry.key for entry in read_manifest(store, name).files.values()}
    for name, version in sorted(every.items()):
        if name not in stays:
            yield Removal(Kind.VERSIONS, PurePosixPath(name), version.size)
