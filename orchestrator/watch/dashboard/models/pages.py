"""Pages of models in 3D for the dashboard: what a finished run has written, or made on request.

`main` makes one in the process of `making`. That of a training is made anew as long as someone looks at it,
but takes no more than a small part of the machine, which may be the one that trains.

A page is a folder whose scripts fetch the model in parts. It runs in an origin of its own, from which
browsers send no cookie, so its address has a random key that grants its files, and nothing else.
"""

import asyncio
import json
import re
import secrets
import shutil
import time
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from fastapi.responses import Response

from panolog.export.site.page import described, photograph_number
from panolog.export.site.write import media_type
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import open_below, read_below, shown_model
from panolog.orchestrator.runs.machines.machine import cores
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.dashboard.models.model_process import Maker, Turns, reading
from panolog.orchestrator.watch.dashboard.pictures import panorama
from panolog.orchestrator.watch.dashboard.responses import Download
from panolog.orchestrator.watch.views.site.photographs import WIDE
from panolog.scene.errors import InputError
from panolog.workers.tasks import TaskId

_CACHED = 8  # pages
_REFRESH_S = 3  # between two looks of a page for a newer model of a training
_SHARE = 0.01  # of the machine's cores that newer models for pages may take
_MOST = 1_000_000  # Gaussians of a page that is made on request
_DESCRIPTION_BYTES = 32_000_000  # of a scene.json at most
_PATH = re.compile(r"/models/([0-9a-f]{48})/.*", re.DOTALL)
_FILE = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*(/[A-Za-z0-9_-][A-Za-z0-9_.-]*)*")
_HOST = re.compile(r"[A-Za-z0-9.-]+(:[0-9]+)?")


def page_policy(host: str, key: str) -> str:
    """The content security policy of a page: an origin of its own, and no other address than its files'.

    It is third-party code, and needs nothing else from this server.
    Args: host, as the client named it; where a policy cannot name it, such as an IPv6 address, the files of
    the whole server may be requested, which that does not let the page read.
    """
    own = f"{host}/models/{key}/" if _HOST.fullmatch(host) else "'self'"
    return (
        f"sandbox allow-scripts allow-downloads; default-src 'none'; script-src {own}; style-src {own};"
        f" img-src {own} data: blob:; connect-src {own} data: blob:; worker-src blob:;"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    )


@dataclass(frozen=True, eq=False)
class _Site:
    """A page that was written."""

    folder: Path
    temporary: bool  # whether it was made for this server
    description: bytes  # scene.json
    names: list[str]  # of the cameras, whose photographs are in `scene`
    scene: Path | None  # None: the photographs are not on this machine
    stays: float = 0.0  # time.monotonic() until which no newer one takes its place

    @staticmethod
    def of(
        folder: Path, scene: Path | None, *, temporary: bool, live: bool = False, stays: float = 0.0
    ) -> "_Site":
        """Args: live, the model may become another. Raises InputError if it is no page."""
        data, names = read_below(folder / "scene.json", folder, _DESCRIPTION_BYTES), list[str]()
        if scene is not None:
            data, names = described(data)
        if live:
            data = json.dumps(json.loads(data) | {"refresh": _REFRESH_S}).encode()
        return _Site(folder, temporary, data, names, scene, stays)


_Source = tuple[RunEntry, str | None, Path | None]  # the arguments of `ModelPages.make`


class ModelPages:
    """The pages that were requested last; those that no run has written are in a temporary folder."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="panolog-dashboard-")
        self._sites: OrderedDict[str, _Site] = OrderedDict()  # by key
        self._keys: dict[tuple[object, ...], str] = {}  # by what they show
        self._sources: dict[str, _Source] = {}  # by key: of those that were made for this server
        self._turns, self._maker = Turns("3D views"), Maker()

    async def begin(self) -> None:
        """Prepares for a page that may soon be requested."""
        await self._maker.start()

    async def make(self, entry: RunEntry, task: str | None, scene: Path | None) -> str:
        """Makes the page of the current model of a run, or of one of its tasks, and returns its key.

        Args: scene, the folder of the run's photographs, None if that is not on this machine.
        Raises InputError if there is no such model, it cannot be read, or too many requests wait.
        """
        model = shown_model(entry.folder, TaskId.parse(task) if task else None)
        known = model.stat()
        shown = (entry.id, task, model.name, known.st_mtime_ns, known.st_size, scene)
        if self._key(shown) is None:
            async with self._turns.take():
                if self._key(shown) is None:
                    key = self._add(shown, await self._site(entry, task, scene, known.st_mtime))
                    self._sources[key] = entry, task, scene
        return self._keys[shown]

    async def renew(self, key: str) -> None:
        """Brings a page up to the present model of its run; one that cannot be made leaves it as it is."""
        source, site = self._sources.get(key), self._sites.get(key)
        if source is None or site is None or time.monotonic() < site.stays:
            return
        known = set(self._sites)
        with suppress(InputError, OSError):
            newest = await self.make(*source)
            if newest == key or key not in self._sites:
                return
            before, self._sites[key] = self._sites[key], self._sites[newest]
            self._sites.move_to_end(key)
            if newest not in known:  # its address was given to no one
                del self._sites[newest]
                self._sources.pop(newest, None)
                self._keys = {what: key if its == newest else its for what, its in self._keys.items()}
            self._remove(before)

    def grants(self, path: str) -> bool:
        """Whether a path of an address is below that of a page."""
        match = _PATH.fullmatch(path)
        return match is not None and match[1] in self._sites

    def file(self, key: str, path: str, policy: str) -> Response:
        """A file of a page, or a photograph. Raises InputError if there is none, or the page was removed."""
        site = self._sites.get(key)
        if site is None:
            raise InputError("this 3D view was removed: open it again")
        # Only pages in an origin of their own, which is "null", may read it: other sites may not.
        headers = {"Content-Security-Policy": policy, "Access-Control-Allow-Origin": "null"}
        if path == "scene.json":
            return Response(site.description, 200, headers | {"Cache-Control": "no-store"}, media_type(path))
        if site.scene is not None and (number := photograph_number(path)) is not None:
            if number >= len(site.names):
                raise InputError("there is no such photograph")
            answer = panorama(site.scene, site.names[number], WIDE)
            answer.headers.update(headers)
            return answer
        path = path or "index.html"
        if _FILE.fullmatch(path) is None:
            raise InputError("there is no such file")
        handle = open_below(site.folder / path, site.folder)
        headers["Cache-Control"] = "private, max-age=3600"
        return Download(handle, media_type(path), headers, None)

    async def close(self) -> None:
        """Removes all pages."""
        await self._maker.close()
        self._folder.cleanup()

    def _key(self, shown: tuple[object, ...]) -> str | None:
        key = self._keys.get(shown)
        if key is not None:
            self._sites.move_to_end(key)
        return key

    def _add(self, shown: tuple[object, ...], site: _Site) -> str:
        key = secrets.token_hex(24)
        self._sites[key], self._keys[shown] = site, key
        while len(self._sites) > _CACHED:
            old, removed = self._sites.popitem(last=False)
            self._keys = {what: key for what, key in self._keys.items() if key != old}
            self._sources.pop(old, None)
            self._remove(removed)
        return key

    def _remove(self, site: _Site) -> None:
        """The files of a page that is under no key any more."""
        if site.temporary and site not in self._sites.values():
            shutil.rmtree(site.folder, ignore_errors=True)

    async def _site(self, entry: RunEntry, task: str | None, scene: Path | None, newest: float) -> _Site:
        """What the run has written for its model, if that is current, else a page made now."""
        web = entry.folder.web
        written = web / "scene.json"
        if task is None and not web.is_symlink() and written.is_file() and written.stat().st_mtime >= newest:
            return await asyncio.to_thread(_Site.of, web, scene, temporary=False)
        output = Path(self._folder.name) / secrets.token_hex(8)
        arguments = [str(entry.root), entry.path, task or "", str(output)]
        seconds = await self._maker.make(__name__, arguments, "the 3D view")
        stays = time.monotonic() + seconds / (_SHARE * cores())
        live = lock.held(entry.folder.lock) and not entry.folder.point_cloud.is_file()
        return await asyncio.to_thread(_Site.of, output, scene, temporary=True, live=live, stays=stays)


def main(root: str, run: str, task: str, output: str) -> None:
    """Makes one page, of files that are really below the run alone. Raises InputError if it cannot."""
    from panolog.export.site.write import write_site  # noqa: PLC0415
    from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run  # noqa: PLC0415

    with reading(RunEntry(Path(root), run)) as (folder, locate):
        wanted = Wanted(TaskId.parse(task) if task else None, most=_MOST)
        shown = site_of_run(folder, wanted, locate)
        write_site(Path(output), shown.write_model, shown.page)
