"""`panolog view`: the page of a model, served on a loopback address while someone looks at it."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from urllib.parse import quote, unquote, urlsplit

from panolog.export.site.page import Page, described, photograph_number
from panolog.export.site.write import DESCRIPTION, MOST_IN_ONE, media_type, site_files, write_site
from panolog.orchestrator.cli.commands.models import say_unmerged
from panolog.orchestrator.cli.options import HTML
from panolog.orchestrator.runs.folder import RunFolder, read_head, shown_model
from panolog.orchestrator.watch.views.site.build import (
    Shown,
    Wanted,
    site_of_file,
    site_of_run,
    write_file,
    write_folder,
)
from panolog.orchestrator.watch.views.site.photographs import STORE_S, photograph
from panolog.scene.errors import InputError, StoreLostError
from panolog.scene.stores.stored_scenes import local_folder
from panolog.scene.write import StageProgress, no_progress

_CACHED = 32  # photographs, of some hundred kilobytes each
_TIMEOUT_S = 60.0  # for a request, and between two of a connection
_LOCAL = {"localhost", "127.0.0.1"}  # names under which a browser on this machine reaches the server
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:;"
    " connect-src 'self' data: blob:; worker-src blob:; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": _POLICY,
}


def page_of(source: Path, wanted: Wanted) -> Shown:
    """The page of a run, or of a file. Raises InputError or RunError as `site_of_run` and `site_of_file`."""
    return site_of_run(RunFolder(source), wanted) if source.is_dir() else site_of_file(source, wanted)


def _say_part(source: Path, wanted: Wanted) -> None:
    """Says that a page is of Stage I once it is written: an error before is one line."""
    if source.is_dir() and wanted.task is None:
        say_unmerged(RunFolder(source), shown_model(RunFolder(source)))


def write_view(source: Path, wanted: Wanted, output: Path, progress: StageProgress = no_progress) -> Shown:
    """Writes the page to `output`: FILE.html as one file, anything else as a folder for any web server.

    Raises InputError or RunError if the model cannot be read or the output is something else; OSError.
    """
    if output.suffix.lower() not in HTML:
        shown = page_of(source, wanted)
        write_folder(shown, output, progress)
        _say_part(source, wanted)
        return shown
    if (wanted.most or 0) > MOST_IN_ONE:
        raise InputError(f"{output}: one file shows at most {MOST_IN_ONE:,} Gaussians; give a folder")
    shown = page_of(source, replace(wanted, most=wanted.most or MOST_IN_ONE))
    write_file(shown, output)
    _say_part(source, wanted)
    return shown


@dataclass(frozen=True, eq=False)
class Site:
    """A written page to serve."""

    folder: Path
    scene: Path | None = None  # of the photographs; None = those in the folder, if any
    start: str = ""  # what the address ends with
    shown: Page | None = None  # None: as another command has written it


@contextmanager
def site_of(source: Path, wanted: Wanted, progress: StageProgress = no_progress) -> Iterator[Site]:
    """The page to serve while the context lasts: RUN/web if it is newer than the model, else a temporary one.

    Raises InputError or RunError as `page_of`; OSError if it cannot be written.
    """
    if (current := _current(source, wanted)) is not None:
        yield current
        return
    progress("converting the model", 0, 0)
    shown = page_of(source, wanted)
    with TemporaryDirectory(prefix="panolog-view-") as folder:
        write_site(Path(folder) / "web", shown.write_model, shown.page)
        _say_part(source, wanted)
        yield Site(Path(folder) / "web", shown.scene, shown=shown.page)


def _current(source: Path, wanted: Wanted) -> Site | None:
    """What a run has written for its model, if that is what is wanted."""
    if source.is_file() or wanted.task is not None or wanted.most is not None:
        return None
    folder = RunFolder(source)
    description = folder.web / DESCRIPTION
    if not description.is_file() or description.stat().st_mtime < shown_model(folder).stat().st_mtime:
        return None
    _, names = described(description.read_bytes())
    if wanted.camera is not None and wanted.camera not in names:
        return None  # a panorama that the plan does not have
    start = "" if wanted.camera is None else f"#camera={quote(wanted.camera, safe='')}"
    scene = local_folder(read_head(folder)[0])
    return Site(folder.web, scene if scene.is_dir() else None, start)


class SiteServer(ThreadingHTTPServer):
    """Serves a written page and its photographs, on a loopback address and to pages of its own alone."""

    daemon_threads = True

    def __init__(self, site: Site, port: int = 0) -> None:
        """Args: port, 0 for a free one. Raises InputError if it is taken, or the page is damaged."""
        self._files = site_files(site.folder)
        self._scene = site.scene
        description = self._files[DESCRIPTION].read_bytes()
        self._names: list[str] = []
        if site.scene is not None:
            description, self._names = described(description)
        self._description = description
        self._copy = lru_cache(maxsize=_CACHED)(partial(photograph, patience=STORE_S))
        self._lock = Lock()
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except OSError as error:
            raise InputError(f"port {port}: {error.strerror}; give another one") from error
        self.url = f"http://127.0.0.1:{self.server_address[1]}/{site.start}"

    def content(self, path: str) -> bytes | Path | None:
        """What is at a path of the address; None if there is nothing."""
        if path == DESCRIPTION:
            return self._description
        if self._scene is not None and (number := photograph_number(path)) is not None:
            return self._photograph(self._scene, number)
        return self._files.get(path or "index.html")

    def _photograph(self, scene: Path, number: int) -> bytes | None:
        """A small copy of the photograph of a camera. One is made at a time."""
        if number >= len(self._names):
            return None
        with self._lock, suppress(InputError, StoreLostError):
            return self._copy(scene, self._names[number])
        return None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = _TIMEOUT_S
    server: SiteServer

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def log_message(self, format: str, *args: object) -> None:
        """Keeps the terminal quiet."""

    def _answer(self, body: bool) -> None:
        if self.headers.get("Host", "").partition(":")[0].lower() not in _LOCAL:  # DNS rebinding
            self._send(
                HTTPStatus.FORBIDDEN, "text/plain", b"this page can be reached as localhost only\n", body
            )
            return
        path = unquote(urlsplit(self.path).path).removeprefix("/")
        content = self.server.content(path)
        if isinstance(content, Path):
            try:
                content = content.read_bytes()
            except OSError:
                content = None
        if content is None:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"there is nothing here\n", body)
            return
        self._send(HTTPStatus.OK, media_type(path or "index.html"), content, body)

    def _send(self, status: HTTPStatus, kind: str, content: bytes, body: bool) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if body:
            with suppress(ConnectionError, TimeoutError):  # the browser has left
                self.wfile.write(content)


def serve(server: SiteServer) -> None:
    """Serves until Ctrl-C or SIGTERM."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        signal.signal(signal.SIGTERM, before)
        server.server_close()
