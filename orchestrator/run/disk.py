"""Which errors mean that a disk takes nothing for now, and what a user reads about them."""

import errno
import os
import re
import shutil
import sqlite3
from pathlib import Path

from panolog.orchestrator.run import lock
from panolog.orchestrator.run.units import gib

_FULL = {errno.ENOSPC, errno.EDQUOT}
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


def why_waiting(error: BaseException, root: Path, size: int = 0) -> str:
    """What a user can do about an error after which writing is tried again; "" for any other error.

    Args: root, the run folder; size, bytes to write where they are known.
    """
    if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
        holders = ", ".join(lock.holders(root / "run.db")) or "another program"
        return f"waiting for {root / 'run.db'}, which {holders} has locked: end it or stop the run"
    code = _code(error)
    if code in _FULL:
        return f"disk full, waiting: free {_missing(root, size)} on the disk of {root} or stop the run"
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
