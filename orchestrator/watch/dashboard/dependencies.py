"""What routes depend on: the run that a request is about, checked bodies, and errors as one line of JSON."""

import asyncio
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from fastapi import Depends, HTTPException, Query, Request
from fastapi.responses import Response
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from panolog.orchestrator.watch.dashboard.registry import RunRegistry, Topic
from panolog.orchestrator.watch.dashboard.responses import json_response
from panolog.orchestrator.watch.dashboard.watch import UNREADABLE, Watch, error_line
from panolog.orchestrator.watch.views.comparison.measured import read_measured
from panolog.orchestrator.watch.views.comparison.reading import ReadRun, UnreadRun
from panolog.orchestrator.watch.views.comparison.schema import MOST
from panolog.orchestrator.watch.views.pages.encoding import encode

_BODY = 4_096  # bytes of a POST at most
_BODY_TIMEOUT_S = 10.0
_RunId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
_RunIds = Annotated[list[_RunId], Query(min_length=2, max_length=MOST)]


class Body(BaseModel):
    """The body of a POST."""

    model_config = ConfigDict(extra="forbid", strict=True)


_Body = TypeVar("_Body", bound=Body)


def registry_of(request: Request) -> RunRegistry:
    """All runs."""
    registry: RunRegistry = request.app.state.registry
    return registry


Registry = Annotated[RunRegistry, Depends(registry_of)]


async def find_run(registry: RunRegistry, id: str) -> tuple[Watch, Topic]:
    """A run by its id, or 404."""
    run = await registry.run(id)
    if run is None:
        raise HTTPException(404, "there is no such run")
    return run


async def fresh_watch(registry: Registry, id: str) -> Watch:
    """A run that can be read, or 404. Refreshed, because its files may have been exchanged."""
    watch, topic = await find_run(registry, id)
    await topic.refresh()
    if watch.snapshot.page is None:
        raise HTTPException(404, watch.snapshot.row.error or "it cannot be read")
    return watch


Run = Annotated[Watch, Depends(fresh_watch)]


async def compared_runs(registry: Registry, run: _RunIds) -> list[Watch | UnreadRun]:
    """The runs of a comparison, refreshed, in the given order; 404 if there is none of them."""
    found: list[Watch | UnreadRun] = []
    for id in dict.fromkeys(run):
        known = await registry.run(id)
        if known is None:
            found.append(UnreadRun(id, id, "there is no such run here, or it was removed"))
        else:
            await known[1].refresh()
            found.append(known[0])
    if not any(isinstance(one, Watch) for one in found):
        raise HTTPException(404, "there are no such runs")
    return found


ComparedRuns = Annotated[list[Watch | UnreadRun], Depends(compared_runs)]


def read_watch(run: Watch | UnreadRun) -> ReadRun | UnreadRun:
    """A run as a comparison needs it."""
    if isinstance(run, UnreadRun):
        return run
    snapshot, state, entry = run.snapshot, run.history.state, run.entry
    if snapshot.page is None:
        return UnreadRun(entry.id, entry.name, snapshot.row.error or "it cannot be read")
    folder, measured, problem = entry.folder, None, ""
    try:
        measured = read_measured(folder)
    except UNREADABLE as error:
        problem = error_line(error, folder.root)
    return ReadRun(entry.id, entry.name, folder, snapshot.page, state, measured, problem)


async def respond(request: Request, status: int, work: Callable[..., Response], *arguments: Any) -> Response:
    """The response that `work` makes in a thread; what a run folder makes it raise becomes `status`."""
    registry = registry_of(request)
    try:
        return await registry.call(work, *arguments)
    except UNREADABLE as error:
        raise HTTPException(status, error_line(error, registry.root)) from error


async def respond_json(
    request: Request, work: Callable[..., Any], *arguments: Any, status: int = 503
) -> Response:
    """Responds as `respond` with what work returns, as JSON; None is 404."""

    def answer() -> Response:
        content = work(*arguments)
        if content is None:
            raise HTTPException(404, "this run has no such item")
        return json_response(request, encode(content))

    return await respond(request, status, answer)


async def body_of(request: Request, kind: type[_Body]) -> _Body:
    """The checked body of a POST, which must be short and arrive in time."""
    try:
        length = int(request.headers.get("content-length", ""))
    except ValueError as error:
        raise HTTPException(411, "a POST must state its length") from error
    if length > _BODY:
        raise HTTPException(413, f"a POST has at most {_BODY} bytes")
    try:
        return kind.model_validate_json(await asyncio.wait_for(request.body(), _BODY_TIMEOUT_S))
    except asyncio.TimeoutError as error:
        raise HTTPException(408, "the body of the POST did not arrive") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise HTTPException(422, f"{'.'.join(map(str, first['loc'])) or 'body'}: {first['msg']}") from error
