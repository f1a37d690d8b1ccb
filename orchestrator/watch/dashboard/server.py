"""The server: one process, one event loop, threads for all that reads files."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from importlib import import_module
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException
from uvicorn.protocols.http.h11_impl import H11Protocol

from panolog.orchestrator.watch.dashboard.api import encoded_map, router
from panolog.orchestrator.watch.dashboard.guard import Access, Guard
from panolog.orchestrator.watch.dashboard.models.downloads import Downloads
from panolog.orchestrator.watch.dashboard.models.pages import ModelPages
from panolog.orchestrator.watch.dashboard.models.routes import router as model_router
from panolog.orchestrator.watch.dashboard.registry import RunRegistry
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.pages.shell import (
    COMPARISON,
    PLOTLY,
    RUN,
    RUNS,
    STATIC,
    Page,
    live_page,
)

_REQUEST_TIMEOUT_S = 15.0  # in which a connection must have sent a request
_MAX_CONNECTIONS = 1_000
_SHUTDOWN_S = 4  # for open answers and the last messages of streams when the server ends


def make_app(root: Path, access: Access, queue: Path | None = None) -> FastAPI:
    """The dashboard of all runs below `root`. Args: queue, folder of the queue that it shows, if any."""
    registry, pages, downloads = RunRegistry(root, queue), ModelPages(), Downloads()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        registry.start(import_module, "scipy.sparse")  # which the first map waits for
        yield
        registry.close()
        await pages.close()
        await downloads.close()
        registry.end()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)
    app.state.registry, app.state.pages, app.state.downloads = registry, pages, downloads
    app.include_router(router)
    app.include_router(model_router)
    app.add_api_route("/", lambda: _page(RUNS))
    app.add_api_route("/runs/{id}", _run)
    app.add_api_route("/compare", lambda: _page(COMPARISON))
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    app.mount("/vendor", StaticFiles(directory=PLOTLY.parent), name="vendor")
    app.add_exception_handler(HTTPException, _error)
    app.add_exception_handler(RequestValidationError, _error)
    app.add_middleware(Guard, access=access, granted=pages.grants)
    return app


def _page(page: Page) -> HTMLResponse:
    return HTMLResponse(live_page(page), headers={"Cache-Control": "no-cache"})


async def _run(request: Request, id: str) -> HTMLResponse:
    registry: RunRegistry = request.app.state.registry
    if found := await registry.run(id):
        watch, topic = found
        topic.start_refresh()  # the page requests the run as soon as its scripts are loaded
        registry.start(encoded_map, watch.entry.folder)  # and then this
    return _page(RUN)


def _error(_: Request, error: Exception) -> Response:
    """Every error as one line of JSON."""
    status, line, headers = 500, "internal error of the server", None
    if isinstance(error, RequestValidationError):
        first = error.errors()[0]
        status, line = 422, f"{'.'.join(map(str, first['loc'][1:]))}: {first['msg']}"
    elif isinstance(error, HTTPException):
        status, line, headers = error.status_code, str(error.detail), error.headers
        if line == HTTPStatus(status).phrase:
            line = line.lower()
    return Response(encode({"error": line}), status, headers, "application/json")


class TimeoutProtocol(H11Protocol):
    """Ends connections that begin a request and do not finish it, for which uvicorn has no time limit."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Starts the timer of a new connection."""
        super().connection_made(transport)
        self._last: Any = self
        self._timer = self.loop.call_later(_REQUEST_TIMEOUT_S, self._check)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the timer."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _check(self) -> None:
        """Closes the connection if no request came since the last check and none is being answered."""
        idle = self.cycle is None or self.cycle.response_complete
        if idle and self._last is self.cycle:
            self.transport.close()
            return
        self._last = self.cycle
        self._timer = self.loop.call_later(_REQUEST_TIMEOUT_S, self._check)


class Server(uvicorn.Server):
    """Ends open streams before it waits for other answers."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Closes the streams, each with a last message, then the server."""
        self.config.app.state.registry.close()  # type: ignore[union-attr]
        await super().shutdown(sockets)


def make_server(root: Path, listener: socket.socket, token: str | None, queue: Path | None = None) -> Server:
    """A server of the runs below `root`: call its `run(sockets=[listener])`. Args: queue, as `make_app`."""
    app = make_app(root, Access(token, listener.getsockname()[1]), queue)
    config = uvicorn.Config(
        app,
        http=TimeoutProtocol,
        ws="none",
        log_level="error",
        access_log=False,
        server_header=False,
        limit_concurrency=_MAX_CONNECTIONS,
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )
    return Server(config)


def serve(root: Path, listener: socket.socket, token: str | None, queue: Path | None = None) -> None:
    """Serves the runs below `root` until Ctrl-C or SIGTERM. Args: queue, as `make_app`."""
    make_server(root, listener, token, queue).run(sockets=[listener])
