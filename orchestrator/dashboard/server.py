"""The server: one process, one event loop, threads for whatever reads files."""

import asyncio
import gzip
import importlib.resources
import os
import secrets
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import cache
from http import HTTPStatus
from importlib.metadata import version
from pathlib import Path

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from panolog.orchestrator.dashboard.api import router
from panolog.orchestrator.dashboard.board import Board
from panolog.orchestrator.dashboard.encoding import encode
from panolog.orchestrator.dashboard.guard import Access, Guard, is_local
from panolog.orchestrator.dashboard.impatient import Impatient
from panolog.orchestrator.dashboard.model_pages import ModelPages
from panolog.orchestrator.dashboard.plans import Maps
from panolog.scene.errors import InputError

STATIC = Path(__file__).with_name("static")
_SILENCE = 60_000  # milliseconds after which a client that takes nothing is cut off
_CONNECTIONS = 1_000
_FAREWELL = 2  # seconds that answers have when the server ends


def make_app(root: Path, access: Access) -> FastAPI:
    """The dashboard of all runs below `root`."""
    board, pages = Board(root), ModelPages()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        packing = asyncio.create_task(board.call(_packed_plotly))  # so that the first page need not wait
        yield
        await packing
        board.close()
        pages.close()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)
    app.state.board, app.state.pages, app.state.maps = board, pages, Maps()
    app.include_router(router)
    app.add_api_route("/", _index)
    app.add_api_route("/runs/{id}", _run)
    app.add_api_route("/static/plotly.min.js", _plotly)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    app.add_exception_handler(HTTPException, _error)
    app.add_exception_handler(RequestValidationError, _error)
    app.add_middleware(Guard, access=access)
    return app


def _index() -> FileResponse:
    return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})


async def _run(request: Request, id: str) -> FileResponse:
    board: Board = request.app.state.board
    if found := await board.run(id):
        found[1].begin()  # the page will ask for it as soon as its scripts are there
    return FileResponse(STATIC / "run.html", headers={"Cache-Control": "no-cache"})


def _plotly(request: Request) -> Response:
    """plotly.min.js as its Python package brings it."""
    tag = f'"plotly-{version("plotly")}"'
    headers = {"Cache-Control": "private, max-age=86400", "ETag": tag, "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    if "gzip" not in request.headers.get("accept-encoding", ""):
        path = importlib.resources.files("plotly") / "package_data" / "plotly.min.js"
        return Response(path.read_bytes(), 200, headers, "text/javascript")
    return Response(_packed_plotly(), 200, headers | {"Content-Encoding": "gzip"}, "text/javascript")


@cache
def _packed_plotly() -> bytes:
    path = importlib.resources.files("plotly") / "package_data" / "plotly.min.js"
    return gzip.compress(path.read_bytes(), 6)


def _error(_: Request, error: Exception) -> Response:
    """Every error is one line of JSON."""
    status, line, headers = 500, "the server has failed", None
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        status, line = 422, f"{'.'.join(map(str, first['loc'][1:]))}: {first['msg']}"
    elif isinstance(error, HTTPException):
        status, line, headers = error.status_code, str(error.detail), error.headers
        if line == HTTPStatus(status).phrase:
            line = line.lower()
    return Response(encode({"error": line}), status, headers, "application/json")


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 for a free one. Raises InputError if that is impossible."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Said in full, or asyncio would not know that it is TCP and would leave Nagle's algorithm on.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _SILENCE)  # its connections inherit it
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{host}:{port}: cannot listen there: {why}; give another --host or --port"
        ) from error
    listener.listen(socket.SOMAXCONN)
    return listener


def token_for(host: str, file: Path) -> str | None:
    """The token that clients must bring: none on this machine's own address, elsewhere that of the user.

    It is kept, so that pages stay open when the server starts again; remove the file for another one.
    Raises OSError if it can be neither read nor kept.
    """
    if is_local(host):
        return None
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        token = file.read_text().strip()
        if len(token) < 32:
            raise InputError(f"{file}: holds no token; remove it") from None
        return token
    with os.fdopen(handle, "w") as new:
        token = secrets.token_urlsafe(32)
        new.write(token)
    return token


def token_file() -> Path:
    """Where a user's token is kept."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "panolog" / "dashboard-token"


def address(listener: socket.socket, host: str, token: str | None) -> str:
    """The URL to open."""
    name = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(host, host)
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{listener.getsockname()[1]}/" + (f"?token={token}" if token else "")


class Server(uvicorn.Server):
    """Lets go of open streams before it waits for answers to end."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Ends."""
        self.config.app.state.board.close()  # type: ignore[union-attr]
        await super().shutdown(sockets)


def make_server(root: Path, listener: socket.socket, token: str | None) -> Server:
    """A server of the runs below `root`, for `run(sockets=[listener])`."""
    app = make_app(root, Access(token, listener.getsockname()[1]))
    config = uvicorn.Config(
        app,
        http=Impatient,
        ws="none",
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_FAREWELL,
    )
    return Server(config)


def serve(root: Path, listener: socket.socket, token: str | None) -> None:
    """Serves the runs below `root` until Ctrl-C or SIGTERM."""
    make_server(root, listener, token).run(sockets=[listener])
