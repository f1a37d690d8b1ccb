"""RUN/driver: what a live driver says where its database takes nothing, because the disk is full.

The file has a fixed size and is overwritten in place, which needs no free space on most file systems. It also
has a token, by which a worker knows that it sees the same folder as the driver.
"""

import errno
import json
import os
import re
import secrets
import shutil
import sqlite3
from contextlib import suppress
from pathlib import Path

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import read_object
from panolog.orchestrator.runs.units import gib
from panolog.scene.files import FULL

_SIZE = 1024  # bytes; of a longer reason the beginning is kept
_REASON = 160  # characters of a reason, each at most six bytes in JSON
_AWAY = {
    errno.EIO,
    errno.EROFS,
    errno.ENODEV,
    errno.ENXIO,
    errno.ESTALE,
    errno.ENOTCONN,
    errno.ECONNABORTED,
    errno.ECONNRESET,
    errno.ETIMEDOUT,
    errno.EHOSTDOWN,
    errno.EHOSTUNREACH,
    errno.ENETUNREACH,
    errno.EREMOTEIO,
}
_SQLITE = {  # the beginnings of its messages: Python 3.10 does not have its codes
    "database or disk is full": errno.ENOSPC,
    "disk I/O error": errno.EIO,
    "unable to open database file": errno.EIO,
    "attempt to write a readonly database": errno.EROFS,
}
_IN_TEXT = re.compile(r"\(os error (\d+)\)")  # of safetensors


class Presence:
    """What the driver that has the run's lock writes into RUN/driver."""

    def __init__(self, path: Path) -> None:
        """Makes the file, with a new token. Without room for it nothing is said, and no worker finds it."""
        self.token = secrets.token_hex(8)
        self._path = path
        self._write("", os.O_CREAT)

    def say(self, waiting: str) -> None:
        """Leaves the reason why the run waits for its disk; "" if it does not. An error changes nothing."""
        self._write(waiting, 0)

    def _write(self, waiting: str, flags: int) -> None:
        content = json.dumps({"token": self.token, "waiting": waiting[:_REASON]}).encode()
        with suppress(OSError):
            handle = os.open(self._path, os.O_WRONLY | os.O_CLOEXEC | flags, 0o644)
            try:
                os.pwrite(handle, content.ljust(_SIZE), 0)
                os.fsync(handle)
            finally:
                os.close(handle)


def waiting(path: Path) -> str:
    """Why a live driver waits for its disk; "" if it does not or nothing is known."""
    return str(read_object(path, _SIZE).get("waiting", ""))


def token(path: Path) -> str:
    """The token of the driver; "" if the file is not here."""
    return str(read_object(path, _SIZE).get("token", ""))


def why_waiting(error: BaseException, root: Path, size: int = 0) -> str:
    """What a user can do about an error after which writing is tried again; "" for any other error.

    Args: root, the run folder; size, bytes to write where they are known.
    """
    if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
        holders = ", ".join(lock.holders(root / "run.db")) or "another program"
        return f"waiting for {root / 'run.db'}, which {holders} has locked: end it or stop the run"
    code = _code(error)
    if code in FULL:
        return f"disk full, waiting: free {_missing(root, size)} on the disk of {root} or stop the run"
    if code in _AWAY | {errno.ENOENT} and not root.exists():
        return f"waiting for {root}, which is gone: put it back or stop the run"
    if code in _AWAY:
        return f"waiting for the disk of {root} ({os.strerror(code)}): make it writable or stop the run"
    return ""


def _missing(root: Path, size: int) -> str:
    try:
        free = shutil.disk_usage(root).free
    except OSError:
        free = 0
    return gib(size - free) if size > free else "some space"


def _code(error: BaseException | None) -> int:
    """The error number of an error or of what has caused it; 0 if there is none."""
    while error is not None:
        if isinstance(error, OSError) and error.errno:
            return error.errno
        if isinstance(error, sqlite3.Error):
            return next((code for text, code in _SQLITE.items() if str(error).startswith(text)), 0)
        if found := _IN_TEXT.search(str(error)):
            return int(found[1])
        error = error.__cause__
    return 0
