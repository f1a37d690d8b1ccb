"""Processes that make something of a model: that needs torch, and more memory than a server should use."""

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.dashboard.discovery import RunEntry, by_handle, open_below
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import Locate

_TIMEOUT_S = 300.0  # for a page or a file
_QUEUED = 4  # requests that may wait at a time


class Turns:
    """Lets requests make something one after another, and only some of them wait."""

    def __init__(self, what: str) -> None:
        """Args: what is made, in the plural, for messages."""
        self._what, self._lock, self._waiting = what, asyncio.Lock(), 0

    @asynccontextmanager
    async def take(self) -> AsyncIterator[None]:
        """Waits until no other request makes something. Raises InputError if too many wait."""
        if self._waiting == _QUEUED:
            raise InputError(f"other {self._what} are being made: try again in a minute")
        self._waiting += 1
        try:
            async with self._lock:
                yield
        finally:
            self._waiting -= 1


async def run_program(module: str, arguments: Sequence[str], what: str) -> None:
    """Runs a module as a program. Raises InputError with its last line if it fails, or takes too long."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", module, *arguments),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, errors = await asyncio.wait_for(process.communicate(), _TIMEOUT_S)
    except asyncio.TimeoutError as error:
        raise InputError(f"{what} was not made within {_TIMEOUT_S:.0f} seconds") from error
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if process.returncode:
        lines = errors.decode(errors="replace").strip().splitlines()
        raise InputError(lines[-1] if lines else f"{what} could not be made")


@contextmanager
def reading(entry: RunEntry) -> Iterator[tuple[RunFolder, Locate]]:
    """The run in such a program, and where its files are read: those that are really below it alone.

    What is wrong with them ends the program with one line.
    """
    import torch  # noqa: PLC0415

    os.nice(10)  # the run may be training on this machine
    torch.set_num_threads(1)
    folder, names = entry.folder, dict[str, str]()

    def locate(path: Path) -> Path:
        opened = by_handle(open_below(path, folder.root))
        names[str(opened)] = path.name
        return opened

    try:
        yield folder, locate
    except PanologError as error:
        text = str(error)
        for opened, name in names.items():
            text = text.replace(opened, name)
        sys.exit(text)
