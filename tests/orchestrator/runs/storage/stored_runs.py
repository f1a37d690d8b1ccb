"""Runs in stores for tests: a driver that writes one, and what a fresh machine finds."""

import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from panolog.orchestrator.runs.database import Database, read_milestones
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import CheckpointSaved, Outcome, Record, RunBegan, RunEnded
from panolog.orchestrator.runs.state import replay
from panolog.orchestrator.runs.storage.fetch import bring
from panolog.orchestrator.runs.storage.layout import current
from panolog.orchestrator.runs.storage.lease import Lease, take
from panolog.orchestrator.runs.storage.mirror import Mirror
from panolog.scene.files import write_bytes
from panolog.scene.stores.store import Store
from panolog.workers.tasks import COARSE


class Driver:
    """Writes a run as the driver does: each file before the record that names it."""

    def __init__(self, root: Path) -> None:
        self.folder = RunFolder(root)
        root.mkdir()
        write_bytes(self.folder.info, b'{"format": 1}')
        self._lock = threading.Lock()
        self._append(RunBegan("here", 1, False))
        self.folder.checkpoint(COARSE).parent.mkdir()
        self.iteration = 0

    def save(self) -> None:
        with self._lock:
            self.iteration += 1
            path = self.folder.checkpoint(COARSE)
            write_bytes(path, str(self.iteration).encode().zfill(3000))
            self._append(CheckpointSaved(COARSE, self.iteration, self.folder.relative(path), 3000))

    def end(self, outcome: Outcome = Outcome.DONE) -> None:
        if outcome in (Outcome.DONE, Outcome.LIMITED):
            write_bytes(self.folder.point_cloud, b"ply" * (1000 + self.iteration))
        self._append(RunEnded(outcome))

    def _append(self, record: Record) -> None:
        """With a connection of its own: the mirror stores files in several threads."""
        with closing(Database(self.folder.database)) as database:
            database.append([record])


def mirror_of(driver: Driver, store: Store, *, force: bool = False) -> tuple[Mirror, Lease]:
    lease = take(store, driver.folder.root, force=force)
    return Mirror(driver.folder, store, lease, current(store)), lease


def rounds(mirror: Mirror, patience: float = 300.0) -> None:
    """As many rounds as it takes, as when the driver has ended."""
    over = threading.Event()
    over.set()
    mirror.follow(over, threading.Event(), 0.01, patience)


def fetched(store: Store, root: Path) -> RunFolder:
    """The run as a fresh machine finds it; checks that what its database names is there."""
    folder = RunFolder(root)
    bring(store, folder, current(store), lambda _: None)
    checkpoint = replay(read_milestones(folder.database)).task(COARSE).checkpoint
    if checkpoint is not None:
        assert int(folder.checkpoint(COARSE).read_bytes()) >= checkpoint
    with closing(sqlite3.connect(folder.database)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    return folder


class Watched(Store):
    after: Callable[[], None] = staticmethod(lambda: None)

    def put(self, path: Path, name: str) -> None:
        super().put(path, name)
        self.after()

    def write(self, name: str, data: bytes, *, new: bool = False) -> bool:
        made = super().write(name, data, new=new)
        self.after()
        return made

    def remove(self, name: str) -> None:
        super().remove(name)
        self.after()

    def copy(self, name: str, other: str) -> None:
        super().copy(name, other)
        self.after()
