"""A process that makes something of models: that needs torch, and more memory than a server should use.

This file is also its program. It reads a line of JSON for each thing to make, with the module that makes it
and the arguments of its `main`, and answers with a line: what was wrong, and the seconds of CPU that it took.
It has imported what it needs by the second one, and ends when nothing was wanted for a while.
"""

import asyncio
import json
import os
import select
import sys
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO

from panolog.orchestrator.runs.folder import RunFolder, by_handle, open_below
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.scene.errors import InputError, PanologError, in_one_line
from panolog.scene.files import Locate

_TIMEOUT_S = 300.0  # for a page or a file
_QUEUED = 4  # requests that may wait at a time
_IDLE_S = 60.0  # after which the process ends


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


class Maker:
    """The process, as long as there is one. For one request at a time."""

    def __init__(self, nice: int = 0) -> None:
        """Args: nice, by how much it is nicer than this process (setpriority(2))."""
        self._nice, self._starting = nice, asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Starts the process, unless it is there: its imports take seconds, and may be over by a request."""
        async with self._starting:
            if self._process is None:
                self._process = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-m", __name__, str(_IDLE_S), str(self._nice)),
                    stdin=asyncio.subprocess.PIPE,
                    stdout=asyncio.subprocess.PIPE,
                    stderr=asyncio.subprocess.DEVNULL,
                )

    async def make(self, module: str, arguments: Sequence[str], what: str) -> float:
        """Calls `main` of a module with arguments, there; returns the seconds of CPU that it took.

        Raises InputError with one line if it fails, or takes too long.
        """
        request = json.dumps([module, *arguments]).encode() + b"\n"
        try:
            answer = await asyncio.wait_for(self._answer(request), _TIMEOUT_S)
        except asyncio.TimeoutError as error:
            await self.close()
            raise InputError(f"{what} was not made within {_TIMEOUT_S:.0f} seconds") from error
        except BaseException:
            await self.close()  # it would answer the next request with this one's end
            raise
        if not answer:
            await self.close()
            raise InputError(f"{what} could not be made")
        wrong, seconds = json.loads(answer)
        if wrong is not None:
            raise InputError(wrong or f"{what} could not be made")
        return float(seconds)

    async def close(self) -> None:
        """Ends the process, whatever it does."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            process.kill()
            await process.wait()

    async def _answer(self, request: bytes) -> bytes:
        """The line that the process answers with, a new one if it has ended meanwhile; b"" if it dies."""
        while True:
            new = self._process is None
            await self.start()
            process = self._process
            assert process is not None and process.stdin is not None and process.stdout is not None
            process.stdin.write(request)
            if answer := await process.stdout.readline():
                return answer
            self._process = None
            if await process.wait() or new:
                return b""


@contextmanager
def reading(entry: RunEntry) -> Iterator[tuple[RunFolder, Locate]]:
    """The run in the process, and where its files are read: those that are really below it alone.

    What is wrong with them raises InputError, with one line.
    """
    folder, names = entry.folder, dict[str, str]()
    handles = list[int]()

    def locate(path: Path) -> Path:
        handles.append(open_below(path, folder.root))
        opened = by_handle(handles[-1])
        names[str(opened)] = path.name
        return opened

    try:
        yield folder, locate
    except PanologError as error:
        text = str(error)
        for opened, name in names.items():
            text = text.replace(opened, name)
        raise InputError(text) from error
    finally:
        for handle in handles:
            os.close(handle)


def _work(requests: IO[bytes], answers: IO[bytes], idle: float, nice: int) -> None:
    """Does what is requested until there are no more requests, or none comes in `idle` seconds."""
    import torch  # noqa: PLC0415

    torch.set_num_threads(1)
    for needed in ("views.site.build", "dashboard.models.pages"):  # no part of a request
        import_module(f"panolog.orchestrator.watch.{needed}")
    os.nice(nice)
    while select.select([requests], [], [], idle)[0] and (line := requests.readline()):
        module, *arguments = json.loads(line)
        began, wrong = time.process_time(), None
        try:
            import_module(module).main(*arguments)
        except InputError as error:
            wrong = str(error)
        except Exception as error:  # noqa: BLE001  # the next request may be another run's
            wrong = f"{type(error).__name__}: {in_one_line(error)}"
        answers.write(json.dumps([wrong, time.process_time() - began]).encode() + b"\n")
        answers.flush()


if __name__ == "__main__":
    with (
        os.fdopen(os.dup(sys.stdout.fileno()), "wb") as own,
        os.fdopen(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as requests,  # as `select` sees it
    ):
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what is printed is no answer
        _work(requests, own, float(sys.argv[1]), int(sys.argv[2]))
    os._exit(0)  # torch takes long to end, and nothing is left to do
