"""Who writes a run in a store: one driver at a time, by a lease with an owner and a time.

Leases are numbered; a new one is an object that must not exist yet. That of the highest number counts. It is
written again while its owner works, and expires after `EXPIRES_S`, by clocks that must agree to some seconds.
"""

import json
import os
import secrets
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.storage.layout import LEASES, newest, number_of, numbered
from panolog.scene.errors import RunLockedError, StoreError, StoreLostError
from panolog.scene.stores.store import Store

EXPIRES_S = 90.0
_REFRESH_S = 20.0
_BOOT, _MOUNTS = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/mnt")
_POLL_S = 1.0  # between two looks at the lease of a mirror on this machine that is about to end


class Lease:
    """A lease that this process holds; a thread refreshes it. Made by `take`."""

    def __init__(self, store: Store, number: int, owner: "_Owner") -> None:
        self.number = number
        self._store, self._owner = store, owner
        self._lost, self._ended = "", threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> str:
        """Who has taken the run over; "" while it is this process's."""
        return self._lost

    def require(self) -> None:
        """Raises RunLockedError if another driver has taken the run over; as `Store` if that is unknown."""
        with self._lock:
            if not self._lost:
                found = newest(self._store, LEASES)
                if found is not None and number_of(found) > self.number:
                    self._lost = _described(_read(self._store, found))
                elif not self._ended.is_set():
                    self._store.write(numbered(LEASES, self.number), self._owner.content())
        if self._lost:
            raise RunLockedError(f"{self._store.url}: {self._lost} has taken the run over; this driver ends")

    def release(self) -> None:
        """Ends the lease; another driver may have the run at once. Raises as `Store`."""
        self.end()
        if not self._lost:
            self._store.write(numbered(LEASES, self.number), self._owner.content(released=True))

    def end(self) -> None:
        """Refreshes the lease no more: it expires, as that of a driver that was killed."""
        self._ended.set()
        self._thread.join()

    def _keep(self) -> None:
        while not self._ended.wait(_REFRESH_S) and not self._lost:
            with suppress(RunLockedError, StoreError, StoreLostError):  # the mirror says what is wrong
                self.require()


def _machine() -> str:
    """The name of this machine since its start, or of this container: two may have one host name."""
    with suppress(OSError):
        return f"{_BOOT.read_text().strip()}:{_MOUNTS.stat().st_ino}"
    return socket.gethostname()


@dataclass(frozen=True)
class _Owner:
    folder: str  # stands for the run's folder on its machine
    machine: str = field(default_factory=_machine)
    token: str = field(default_factory=lambda: secrets.token_hex(8))

    def content(self, *, released: bool = False) -> bytes:
        """The lease as it is written now."""
        held = {"owner": self.token, "folder": self.folder, "time": time.time(), "released": released}
        who = {"host": socket.gethostname(), "machine": self.machine, "pid": os.getpid()}
        return json.dumps(held | who).encode()


def take(store: Store, root: Path, *, force: bool, again: bool = False) -> Lease:
    """Takes the lease of a run.

    Where only the mirror of this machine's last driver is left, it waits for its end.
    Args: root, the run's folder on this machine; force, also from a driver that may still be at work; again,
    also that of the driver at work here, whose mirror was killed.
    Raises RunLockedError if another driver has it; StoreError, StoreLostError as `Store`.
    """
    owner = _Owner(sha256(str(root.resolve()).encode()).hexdigest()[:16])
    while True:
        found = newest(store, LEASES)
        held = _read(store, found) if found else {}
        own = (held.get("machine"), held.get("folder")) == (owner.machine, owner.folder)
        if _live(held) and not force and not (own and again):
            if own and not lock.held(root / "lock"):
                time.sleep(_POLL_S)
                continue
            left = float(held["time"]) + EXPIRES_S - time.time()
            raise RunLockedError(
                f"{store.url}: {_described(held)} is at work on it; stop that one first. If it is gone,"
                f" this works in {left:.0f} s, or at once with `panolog resume --force`"
            )
        number = (number_of(found) if found else 0) + 1
        name = numbered(LEASES, number)
        # A request that was repeated may have been served the first time.
        if store.write(name, owner.content(), new=True) or _read(store, name).get("owner") == owner.token:
            return Lease(store, number, owner)


def holder(store: Store) -> str:
    """Who writes the run now; "" if no driver does. Raises as `Store`."""
    found = newest(store, LEASES)
    held = _read(store, found) if found else {}
    return _described(held) if _live(held) else ""


def _read(store: Store, name: str) -> dict[str, Any]:
    """A lease; nothing if it is gone. One that is damaged is held since it was written, by some machine."""
    content = store.read(name)
    if content is None:
        return {}
    with suppress(ValueError, TypeError):
        found = json.loads(content)
        if isinstance(found, dict) and isinstance(found.get("time"), int | float):
            return found
    version = store.version(name)
    return {"time": version.modified} if version is not None else {}


def _live(held: dict[str, Any]) -> bool:
    return bool(held) and not held.get("released") and time.time() < float(held["time"]) + EXPIRES_S


def _described(held: dict[str, Any]) -> str:
    return f"a driver on {held.get('host', 'another machine')}"
