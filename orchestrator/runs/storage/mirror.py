"""The mirror of a run: copies what the driver makes into a store, so that the store is whole at any moment.

A round stores the files that have changed, takes a snapshot of run.db, stores what has changed meanwhile and
the snapshot; then the manifest, and at last the pointer. The driver writes a file before the record that
names it, so whatever the snapshot names is in the store before it counts. Nothing is removed.
"""

import os
import secrets
import shutil
import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.database import read_milestones
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome
from panolog.orchestrator.runs.sql import reading
from panolog.orchestrator.runs.state import RunState, Status, replay
from panolog.orchestrator.runs.storage.layout import (
    DATABASE,
    INFO,
    MANIFESTS,
    OBJECTS,
    POINTERS,
    Manifest,
    StoredFile,
    is_result,
    is_work,
    mirrored,
    numbered,
    put_pointer,
)
from panolog.orchestrator.runs.storage.lease import Lease
from panolog.orchestrator.runs.storage.state import MirrorState, write_state
from panolog.scene.errors import RunFolderError, RunLockedError, StoreError, StoreLostError, in_one_line
from panolog.scene.files import sha256
from panolog.scene.stores.store import Store

_THREADS = 4  # files stored at a time
_SHARE = 10  # a pause is at least so many times as long as writing run.db and the manifest took
_RATE = 500_000.0  # bytes a second that copies of run.db may take in the store on average, as they all stay
_LONGEST_S = 120.0  # between two tries while a store fails
_PASSING = (StoreError, StoreLostError, RunFolderError, sqlite3.OperationalError, OSError)
Stamp = tuple[int, int, int]  # size, time of change in ns, inode


class Mirror:
    """The mirror of one run, at work. Args: known, what the store has already; lease, which it holds."""

    def __init__(self, folder: RunFolder, store: Store, lease: Lease, known: Manifest | None) -> None:
        self._folder, self._store, self._lease = folder, store, lease
        self._files: dict[str, StoredFile] = dict(known.files) if known else {}  # that the pointer names
        self._stored: dict[str, tuple[Stamp, StoredFile]] = {}  # as they are now
        self._state = MirrorState(str(store.url), published=known.name if known else "")
        self._lock = threading.Lock()  # of `_state`
        self._pause = 0.0  # seconds before the next round, at least
        self._begun = known is not None  # whether the store has anything of the run that took time
        self._own: list[str] = []  # keys that this mirror has made until then, in order
        for left in folder.mirror.parent.glob("*.part"):  # of a mirror that was killed
            left.unlink()

    @property
    def state(self) -> MirrorState:
        return self._state

    def follow(self, ended: threading.Event, stop: threading.Event, period: float, patience: float) -> None:
        """Works until the driver has ended and all is out, or nothing has got out for so long after that.

        Args: ended, set when the run's command has ended; stop, set to end at once; period and patience in
        seconds.
        """
        pause, moved = period, time.monotonic()
        while True:
            # Before the round: what an ended driver has written is then copied by it.
            over = ended.is_set() and not lock.held(self._folder.lock)
            before = self._state.pending_files, self._state.published, len(self._stored)
            if self._try(last=over):
                pause = max(period, self._pause)
                if over:
                    return
            elif self._lease.lost or stop.is_set():
                return
            else:
                pause = min(2 * pause, _LONGEST_S)
            if before != (self._state.pending_files, self._state.published, len(self._stored)) or not over:
                moved = time.monotonic()
            if over and time.monotonic() - moved > patience:
                return
            (stop if ended.is_set() else ended).wait(min(pause, period) if over else pause)

    def _try(self, *, last: bool) -> bool:
        """One round. Returns whether all is out that there was at its begin."""
        try:
            if self._folder.info.exists() and self._folder.database.exists():
                self.round(last=last)
            elif self._begun:
                self._say(problem=f"{self._folder.root} is gone, or no run any more; the store keeps the run")
            elif last:
                self._withdraw()
        except RunLockedError as error:
            self._say(problem=str(error))
            return False
        except _PASSING as error:
            self._say(problem=in_one_line(error))
            return False
        return True

    def round(self, *, last: bool = False) -> None:
        """Copies what has changed, and publishes it.

        Args: last, whether the driver has ended, so that results get their names. Raises RunLockedError if
        another driver has taken the run over, and what the store or the disk raises.
        """
        self._lease.require()
        first = self._send(self._present())
        began, moment = time.monotonic(), time.time()
        snapshot = self._snapshot()
        try:
            taken = time.monotonic()
            files = first | self._send(self._present())
            began += time.monotonic() - taken
            state = replay(read_milestones(snapshot))
            entry = self._put(snapshot, DATABASE, self._files.get(DATABASE))
        finally:
            snapshot.unlink(missing_ok=True)
        lost = {
            name: self._files[name]
            for name in _needed(self._folder, state) & self._files.keys() - files.keys()
        }
        files |= lost
        self._begun |= state.prepared or any(map(is_work, files))
        self._publish(files | {DATABASE: entry}, moment)
        self._pause = max(_SHARE * (time.monotonic() - began), entry.size / _RATE)
        if last and state.outcome in (Outcome.DONE, Outcome.LIMITED):
            self._copy_results(files)
        gone = f"no longer in {self._folder.root}, but kept in the store: {', '.join(sorted(lost))}"
        self._say(problem=gone if lost else "", pending_files=0, pending_bytes=0, since=moment, complete=last)

    def _present(self) -> dict[str, Stamp]:
        """The files of the run that are copied out, as they are now; run.json last."""
        root, found = str(self._folder.root), dict[str, Stamp]()
        for place, folders, names in os.walk(root):
            inner = os.path.relpath(place, root)
            folders[:] = [it for it in folders if mirrored(_joined(inner, it) + "/_")]
            for name in names:
                relative = _joined(inner, name)
                with suppress(FileNotFoundError):  # it was replaced
                    if mirrored(relative) and (path := Path(place, name)).is_file():
                        status = path.stat()
                        found[relative] = (status.st_size, status.st_mtime_ns, status.st_ino)
        if info := found.pop(INFO, None):
            found[INFO] = info
        return found

    def _send(self, present: dict[str, Stamp]) -> dict[str, StoredFile]:
        """Stores those of the files that have changed. Returns what is in the store of all of them.

        Raises the first error after what could be stored is.
        """
        changed = {it: stamp for it, stamp in present.items() if self._stored.get(it, (None,))[0] != stamp}
        left, total = len(changed), sum(size for size, *_ in changed.values())
        failed: Exception | None = None
        with ThreadPoolExecutor(_THREADS, "mirror") as threads:
            works = {threads.submit(self._send_one, it, stamp): stamp for it, stamp in changed.items()}
            for work in as_completed(works):
                try:
                    work.result()
                    left, total = left - 1, total - works[work][0]
                except _PASSING as error:
                    failed = failed or error
                self._say(pending_files=left, pending_bytes=total)
        if failed is not None:
            raise failed
        for gone in self._stored.keys() - present.keys():
            del self._stored[gone]
        return {name: self._stored[name][1] for name in present if name in self._stored}

    def _send_one(self, name: str, stamp: Stamp) -> None:
        held = self._folder.mirror.with_name(f"{secrets.token_hex(4)}.part")
        try:
            if not self._hold(self._folder.root / name, held):
                return  # it is gone: the next look does not find it either
            known = self._stored[name][1] if name in self._stored else self._files.get(name)
            self._stored[name] = (stamp, self._put(held, name, known))
        finally:
            held.unlink(missing_ok=True)

    @staticmethod
    def _hold(path: Path, held: Path) -> bool:
        """A name for the bytes that a file has now: what replaces it is another file. False if it is gone."""
        held.parent.mkdir(exist_ok=True)
        try:
            if path.is_symlink():
                shutil.copy2(path, held)
            else:
                os.link(path, held)
        except FileNotFoundError:
            return False
        except OSError:  # a file system without hard links
            shutil.copy2(path, held)
        return True

    def _put(self, path: Path, name: str, known: StoredFile | None) -> StoredFile:
        """Stores a file that does not change as a new object, unless a known one has the same bytes."""
        status = path.stat()
        key = f"{OBJECTS}/{name}/{time.time_ns():x}-{secrets.token_hex(4)}"
        entry = StoredFile(key, status.st_size, sha256(path).hex(), status.st_mtime_ns)
        if known is not None and (known.size, known.sha256) == (entry.size, entry.sha256):
            return known
        self._note(key)
        self._store.put(path, key)
        return entry

    def _snapshot(self) -> Path:
        copy = self._folder.mirror.with_name(f"{secrets.token_hex(4)}.db.part")
        copy.parent.mkdir(exist_ok=True)
        with reading(self._folder.database) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
        return copy

    def _publish(self, files: dict[str, StoredFile], moment: float) -> None:
        if files == self._files:
            return
        self._lease.require()
        manifest = Manifest(f"{MANIFESTS}/{time.time_ns():x}-{secrets.token_hex(4)}", files)
        packed = manifest.pack()
        self._note(manifest.name)
        self._note(numbered(POINTERS, self._lease.number))
        self._store.write(manifest.name, packed)
        self._say(announced=manifest.name)
        put_pointer(self._store, self._lease.number, manifest, packed)
        self._files = files
        self._say(published=manifest.name, since=moment)

    def _copy_results(self, files: dict[str, StoredFile]) -> None:
        """Copies the results of a run that has a model to their own names in the store, for people."""
        for name, entry in files.items():
            if is_result(name) and entry.key != name:  # as an earlier version has stored it
                self._store.copy(entry.key, name)

    def _withdraw(self) -> None:
        """Removes what this mirror has stored of a run that was refused before anything was made."""
        for key in dict.fromkeys(reversed(self._own)):  # the pointer first
            self._store.remove(key)
        self._say(complete=True)

    def _note(self, key: str) -> None:
        """Takes note of a key that this mirror makes, as long as the run may be withdrawn."""
        if not self._begun:
            self._own.append(key)

    def _say(self, **changes: object) -> None:
        with self._lock:
            self._state = replace(self._state, **changes)  # type: ignore[arg-type]
            if self._folder.info.exists():
                write_state(self._folder.mirror, self._state)


def _needed(folder: RunFolder, state: RunState) -> set[str]:
    """The files that records name and that a resume or a user would miss."""
    found = [folder.info, *([folder.point_cloud] if state.merged is not None else [])]
    for task in state.tasks.values():
        if task.status == Status.DONE:  # of a run that is done, `clean` removes the models of parts
            found += [] if state.outcome == Outcome.DONE else [folder.model(task.id)]
        elif task.checkpoint is not None:
            found.append(folder.checkpoint(task.id))
    return {folder.relative(path) for path in found}


def _joined(folder: str, name: str) -> str:
    return name if folder == "." else f"{folder}/{name}"
