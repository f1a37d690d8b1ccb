"""Pages of models in 3D for the dashboard, each made by a process of its own on request.

A model needs torch and far more memory than a server should use, so this file is also the program that
makes one page: `python -m panolog.orchestrator.dashboard.model_pages ROOT RUN TASK OUTPUT`.
"""

import asyncio
import os
import sys
from collections import OrderedDict
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

from panolog.orchestrator.dashboard.discovery import RunEntry, by_handle, open_below
from panolog.orchestrator.run.folder import model_of
from panolog.scene.errors import InputError, PanologError
from panolog.workers.tasks import TaskId

# The page runs in an origin of its own: it is third-party code, and needs nothing from this server.
PAGE_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval';"
    " style-src 'unsafe-inline'; img-src data: blob:; font-src data:; worker-src data: blob:;"
    " connect-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
_CACHED = 8  # pages
_QUEUED = 4  # requests that may wait at a time
_TIMEOUT_S = 300.0  # for one page


class ModelPages:
    """The pages that were requested last, in a temporary folder."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="panolog-dashboard-")
        self._pages: OrderedDict[str, Path] = OrderedDict()
        self._lock = asyncio.Lock()
        self._waiting = 0

    async def make(self, entry: RunEntry, task: str | None) -> str:
        """Makes the page of the current model of a run, or of one of its tasks, and returns its key.

        Raises InputError if there is no such model, it cannot be read, or too many requests wait.
        """
        model = model_of(entry.folder, TaskId.parse(task) if task else None)
        known = model.stat()
        key = sha256(f"{entry.id} {task} {model.name} {known.st_mtime_ns} {known.st_size}".encode())
        name = key.hexdigest()[:24]
        if name not in self._pages:
            if self._waiting == _QUEUED:
                raise InputError("other 3D views are being made: try again in a minute")
            self._waiting += 1
            try:
                async with self._lock:
                    if name not in self._pages:
                        await self._write(entry, task, name)
            finally:
                self._waiting -= 1
        return name

    def page(self, key: str) -> Path:
        """The file of a page. Raises InputError if there is none of that key any more."""
        if key not in self._pages:
            raise InputError("this 3D view was removed: open it again")
        self._pages.move_to_end(key)
        return self._pages[key]

    def close(self) -> None:
        """Removes all pages."""
        self._folder.cleanup()

    async def _write(self, entry: RunEntry, task: str | None, name: str) -> None:
        output = Path(self._folder.name) / f"{name}.html"
        arguments = [str(entry.root), entry.path, task or "", str(output)]
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", __name__, *arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            _, errors = await asyncio.wait_for(process.communicate(), _TIMEOUT_S)
        except asyncio.TimeoutError as error:
            raise InputError(f"the 3D view was not made within {_TIMEOUT_S:.0f} seconds") from error
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode:
            lines = errors.decode(errors="replace").strip().splitlines()
            raise InputError(lines[-1] if lines else "the 3D view could not be made")
        self._pages[name] = output
        while len(self._pages) > _CACHED:
            self._pages.popitem(last=False)[1].unlink(missing_ok=True)


def _main(root: str, run: str, task: str, output: str) -> None:
    """Makes one page, of files that are really below the run alone."""
    import torch  # noqa: PLC0415

    from panolog.orchestrator.views.model_page import write_run_page  # noqa: PLC0415

    os.nice(10)  # the run may be training on this machine
    torch.set_num_threads(1)
    folder = RunEntry(Path(root), run).folder
    names: dict[str, str] = {}

    def locate(path: Path) -> Path:
        opened = by_handle(open_below(path, folder.root))
        names[str(opened)] = path.name
        return opened

    try:
        write_run_page(folder, TaskId.parse(task) if task else None, Path(output), locate=locate)
    except PanologError as error:
        text = str(error)
        for opened, name in names.items():
            text = text.replace(opened, name)
        sys.exit(text)


if __name__ == "__main__":
    _main(*sys.argv[1:])
