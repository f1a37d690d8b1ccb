"""RUN/driver: what a live driver says where its database takes nothing, because the disk is full.

The file has a fixed size and is overwritten in place, which needs no free space on most file systems. It also
has a token, by which a worker knows that it sees the same folder as the driver.
"""

import json
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

_SIZE = 1024  # bytes; of a longer reason the beginning is kept
_REASON = 160  # characters of a reason, each at most six bytes in JSON


class Presence:
    """The writer: the driver that has the run's lock."""

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
    return str(_read(path).get("waiting", ""))


def token(path: Path) -> str:
    """The token of the driver; "" if the file is not here."""
    return str(_read(path).get("token", ""))


def _read(path: Path) -> dict[str, Any]:
    """The content; nothing if it is missing, not plain or half written."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return {}
    try:
        content = json.loads(os.read(handle, _SIZE))
    except (OSError, ValueError):
        return {}
    finally:
        os.close(handle)
    return content if isinstance(content, dict) else {}
