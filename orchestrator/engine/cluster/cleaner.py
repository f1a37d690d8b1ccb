"""Clears up after a session of Ray whose driver has ended. Separate: it is a process, `python -m … FOLDER`.

It waits for the end of its standard input, which only the driver has open. A driver that ends by itself
writes to it first. If the driver was killed, Ray's processes notice one by one, some after a minute: every
process that has a file of the session open, such as its log, is killed.
"""

import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil

_AGAIN = 0.1  # seconds between two attempts: a process may still write while it ends


def clean(folder: Path, *, orphaned: bool) -> None:
    """Removes a folder; of a driver that was killed, also kills the processes that use it."""
    while folder.exists():
        users = [process for process in psutil.process_iter() if _uses(process, folder)] if orphaned else []
        for process in users:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        time.sleep(_AGAIN)
        shutil.rmtree(folder, ignore_errors=True)


def _uses(process: psutil.Process, folder: Path) -> bool:
    with suppress(psutil.Error):  # gone, or another user's
        return any(Path(file.path).is_relative_to(folder) for file in process.open_files())
    return False


if __name__ == "__main__":
    ended = sys.stdin.read()
    clean(Path(sys.argv[1]), orphaned=not ended)
