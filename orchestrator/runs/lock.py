"""One driver for each run folder: a lock that ends with its holder and can be queried without being taken.

Open-file-description locks of Linux: unlike POSIX record locks they also keep apart two openers in a process.
"""

import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from panolog.scene.errors import RunFolderError, RunLockedError

_FLOCK = "hhqqi4x"  # struct flock: type, whence, start, length, pid


@contextmanager
def hold(path: Path) -> Iterator[None]:
    """Holds the lock while the context lasts.

    Raises InputError if another process has it or the folder cannot be written.
    """
    handle = _take(path)
    try:
        yield
    finally:
        os.close(handle)


def _take(path: Path) -> int:
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RunFolderError(f"{path.parent}: cannot be written: {error.strerror}") from error
        try:
            fcntl.fcntl(handle, fcntl.F_OFD_SETLK, _request(fcntl.F_WRLCK))
            if path.stat().st_ino == os.fstat(handle).st_ino:
                return handle
        except (BlockingIOError, PermissionError) as error:
            os.close(handle)
            raise RunLockedError(
                f"{path.parent}: another driver is at work on it; stop that one first"
            ) from error
        except FileNotFoundError:
            pass
        os.close(handle)  # a driver that was refused has removed the file in between: take a new one


def held(path: Path) -> bool:
    """Whether some process holds the lock. Takes nothing and writes nothing."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        answer = fcntl.fcntl(handle, fcntl.F_OFD_GETLK, _request(fcntl.F_WRLCK))
    finally:
        os.close(handle)
    kind: int = struct.unpack(_FLOCK, answer)[0]
    return kind != fcntl.F_UNLCK


def holders(path: Path) -> list[str]:
    """Which programs of this machine have locks on a file, where Linux shows it: `name (process number)`."""
    try:
        status = path.stat()
        lines = Path("/proc/locks").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    device = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    # "1: POSIX ADVISORY READ 77 fe:01:1234 0 EOF", with "->" before the type of a lock that is waited for
    fields = [line.split() for line in lines if "->" not in line]
    found = {row[4] for row in fields if len(row) > 5 and row[5] == device}
    return [_program(pid) for pid in sorted(found - {str(os.getpid())}) if pid.isdecimal()]


def _program(pid: str) -> str:
    try:
        command = Path("/proc", pid, "cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
    except OSError:
        return f"process {pid}"
    return f"`{' '.join(command.split())[:80]}` (process {pid})"


def _request(kind: int) -> bytes:
    return struct.pack(_FLOCK, kind, os.SEEK_SET, 0, 0, 0)
