"""From a request to the run that it is about, and from what a run folder does to us to one line."""

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import HTTPException, Request
from fastapi.responses import Response
from pydantic import BaseModel, ValidationError

from panolog.orchestrator.dashboard.board import Board, Topic
from panolog.orchestrator.dashboard.encoding import encode, json_response
from panolog.orchestrator.dashboard.model_pages import ModelPages
from panolog.orchestrator.dashboard.snapshot import Snapshot
from panolog.orchestrator.dashboard.watch import UNREADABLE, Watch
from panolog.scene.errors import InputError

_BODY = 4_096  # bytes of a POST at most
_PATIENCE = 10.0  # seconds in which it must have come
_LINE = 300  # characters of an error at most
_Body = TypeVar("_Body", bound=BaseModel)


def board_of(request: Request) -> Board:
    """All runs."""
    board: Board = request.app.state.board
    return board


def pages_of(request: Request) -> ModelPages:
    """All models in 3D."""
    pages: ModelPages = request.app.state.pages
    return pages


async def found(request: Request, id: str) -> tuple[Watch, Topic]:
    """A run by its id, or 404."""
    run = await board_of(request).run(id)
    if run is None:
        raise HTTPException(404, "there is no such run")
    return run


async def seen(request: Request, id: str) -> tuple[Watch, Snapshot]:
    """A run and how it stands now, or 404."""
    watch, topic = await found(request, id)
    await topic.look()
    snapshot = watch.snapshot
    if snapshot.page is None:
        raise HTTPException(404, snapshot.row["error"] or "it cannot be read")
    return watch, snapshot


async def watch_of(request: Request, id: str) -> Watch:
    """A run that can be read, or 404. Looked at anew, for its files may have become others."""
    return (await seen(request, id))[0]


async def carefully(
    request: Request, status: int, work: Callable[..., Response], *arguments: Any
) -> Response:
    """What work in a thread returns; what a run folder can do to it becomes `status` and one line."""
    try:
        return await board_of(request).call(work, *arguments)
    except UNREADABLE as error:
        raise HTTPException(status, line_of(request, error)) from error


async def reply(request: Request, work: Callable[..., Any], *arguments: Any, status: int = 503) -> Response:
    """The same for work that returns what becomes JSON; None is 404."""

    def answer() -> Response:
        content = work(*arguments)
        if content is None:
            raise HTTPException(404, "there is no such thing in this run")
        return json_response(request, encode(content))

    return await carefully(request, status, answer)


async def body_of(request: Request, kind: type[_Body]) -> _Body:
    """The checked body of a POST, which must be short and come soon."""
    try:
        length = int(request.headers.get("content-length", ""))
    except ValueError as error:
        raise HTTPException(411, "a POST must say its length") from error
    if length > _BODY:
        raise HTTPException(413, f"a POST has at most {_BODY} bytes")
    try:
        return kind.model_validate_json(await asyncio.wait_for(request.body(), _PATIENCE))
    except asyncio.TimeoutError as error:
        raise HTTPException(408, "the POST did not come") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise HTTPException(422, f"{'.'.join(map(str, first['loc'])) or 'body'}: {first['msg']}") from error


def line_of(request: Request, error: Exception) -> str:
    """An error of a run folder in one line, without where the dashboard's folder is."""
    line = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return " ".join(line.replace(f"{board_of(request).root}/", "").split())[:_LINE]
