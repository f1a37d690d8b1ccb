"""What the dashboard answers: the contract between its server and its pages, or any other program.

All JSON; times in seconds since the epoch, sizes in bytes, rates per second. A run is named by an id of 16
hex digits: no path ever comes from a client. An error is {"error": one line} with 403 (see `guard`), 404,
409 (it makes no sense now), 422 (a parameter is nonsense) or 503 (the run cannot be read just now).

GET /, /runs/{id}, /static/…
    Pages, scripts and styles. /static/plotly.min.js is that of the plotly package.
GET /api/runs
    {"folder", "runs": [row…]}, newest first. A row: id, name (path below FOLDER), scene, status, stage,
    stage_label, progress (0 to 1, of the whole run), eta, psnr, gaussians, size (of the PLY), created,
    latest, seconds, error. status is that of `panolog status --json`, "unread" (not looked at yet) or
    "unreadable" (error says why).
GET /api/runs/{id}
    {"id", "name", "path" (the whole), "info" (run.json), "summary" (`panolog status --json`), "now", "began",
    "latest", "progress", "eta" (both of the whole run), "paused": [block…],
    "stages": [{name, label, status, began, ended, progress, tasks, done}…],
    "nodes": [{node, tasks: [names running], gpus: [kinds], device, memory, rate}…],
    "config": [{key, value, default, changed, unit_or_doc}…],
    "actions": {allowed, why, available: [names], failed: last line of a driver that was started from here},
    "result": {model, report}}
GET /api/runs/{id}/map
    A plotly figure {"data", "layout", "blocks"}: see `figures.map_figure`. Its cells all wait: how they stand
    changes too often.
GET /api/runs/{id}/camera/{row}
    {"row", "name", "block", "scores": […], "assigned": {block: reason}}
GET /api/runs/{id}/series?task=&points=
    {"loss": {"iteration": […], "time": […], "value": […]}, "psnr", "gaussians", "rate", "memory",
    "rate/means"…}: at most `points` (600) of each.
GET /api/runs/{id}/events?before=&after=&limit=&type=&task=&text=
    {"events": [{id, time, type, task, …}…], "more", "next"}: newest first, at most `limit` (200). `type` may
    be repeated; with "-" before it is left out. If "more", go on with before="next": a search for a text can
    come back with few events or none and still have more to look through.
GET /api/runs/{id}/previews[?task=]
    {"previews": [{event, task, iteration, view, time}…]}: the latest of each task, or all of one, newest
    first.
GET /api/runs/{id}/previews/{event}
    JPEG, the render above the truth.
GET /api/runs/{id}/views
    {"views": [{number, name, metrics}…]}: held-out panoramas.
GET /api/runs/{id}/views/{number}
    JPEG, the render above the truth.
GET /api/runs/{id}/point_cloud.ply
    The model, to save.
GET /api/runs/{id}/report.html[?save=1]
    The report: to look at, in a sandbox of its own, or to save.
GET /api/stream[?run=ID][&changes=1]
    Server-sent events; without run of the list. The first message is everything: "runs" as /api/runs, "run"
    as /api/runs/{id}; again whenever it is different, at most twice a second. "events": {"events": […]} that
    have come since the connection, newest first, at most 200 and of progress only the latest of each task.
    "gone": {"error"}: the run cannot be read (any more). With changes=1 "changes" takes the place of all
    "run" but the first, unless most is different: {"id", "now", "latest", "progress", "eta",
    "paused", "stages", "nodes", "actions", "result", "summary" without tasks and blocks, "tasks": those that
    differ}.
POST /api/runs/{id}/actions
    {"action": "stop"|"resume"|"retry"|"pause"|"unpause", "block": n|null} → 202 {"accepted": true}
POST /api/runs/{id}/viewer
    {"task": null|"coarse"|"block/003"} → {"url"} of a page with the model in 3D; it takes seconds to make.

A POST needs `X-PanoLOG: 1` and the content type application/json.
"""

from typing import Annotated, Literal

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from panolog.orchestrator.dashboard import pictures, plans, stream
from panolog.orchestrator.dashboard.asking import (
    board_of,
    body_of,
    carefully,
    found,
    line_of,
    pages_of,
    reply,
    seen,
    watch_of,
)
from panolog.orchestrator.dashboard.encoding import encode, json_response
from panolog.orchestrator.dashboard.files import Download
from panolog.orchestrator.dashboard.model_pages import PAGE_POLICY
from panolog.orchestrator.views import queries
from panolog.scene.errors import InputError

router = APIRouter()
_ID = Field(ge=0, lt=2**63)


class Wish(BaseModel):
    """The body of a POST to /actions."""

    model_config = ConfigDict(extra="forbid", strict=True)

    action: Literal["stop", "resume", "retry", "pause", "unpause"]
    block: int | None = None


class Model(BaseModel):
    """The body of a POST to /viewer."""

    model_config = ConfigDict(extra="forbid", strict=True)

    task: str | None = None


@router.get("/api/runs")
async def get_runs(request: Request) -> Response:
    """The list."""
    board = board_of(request)
    await board.list.look()
    return json_response(request, board.data)


@router.get("/api/runs/{id}")
async def get_run(request: Request, id: str) -> Response:
    """All about one run."""
    _, snapshot = await seen(request, id)
    return await board_of(request).call(json_response, request, snapshot.data)


@router.get("/api/runs/{id}/map")
async def get_map(request: Request, id: str) -> Response:
    """Its plan from above."""
    watch = await watch_of(request, id)
    maps: plans.Maps = request.app.state.maps
    return await carefully(request, 404, lambda: json_response(request, maps.of(watch.place)))


@router.get("/api/runs/{id}/camera/{row}")
async def get_camera(request: Request, id: str, row: int) -> Response:
    """One training camera of its plan."""
    watch = await watch_of(request, id)
    return await reply(request, plans.camera_of, watch.place, row, status=404)


@router.get("/api/runs/{id}/series")
async def get_series(
    request: Request, id: str, task: str, points: Annotated[int, Query(ge=2, le=5_000)] = 600
) -> Response:
    """The curves of a task."""
    watch = await watch_of(request, id)
    return await reply(request, queries.series, watch.place.folder.database, task, points)


@router.get("/api/runs/{id}/events")
async def get_events(
    request: Request,
    id: str,
    before: Annotated[int | None, _ID] = None,
    after: Annotated[int, _ID] = 0,
    limit: Annotated[int, Query(ge=1, le=1_000)] = 200,
    type: Annotated[list[str] | None, Query(max_length=50)] = None,
    task: str | None = None,
    text: Annotated[str, Query(max_length=200)] = "",
) -> Response:
    """A page of its history."""
    watch, types = await watch_of(request, id), frozenset(filter(None, type or ()))
    without = frozenset(name[1:] for name in types if name.startswith("-"))
    only = frozenset(name for name in types if not name.startswith("-"))
    wanted = queries.Filter(before, after, only, without, task or None, text)
    return await reply(request, queries.events, watch.place.folder.database, wanted, limit)


@router.get("/api/runs/{id}/previews")
async def get_previews(request: Request, id: str, task: str | None = None) -> Response:
    """Which pictures of the run in progress there are."""
    watch = await watch_of(request, id)
    return await reply(request, pictures.previews, watch.place.folder.database, task)


@router.get("/api/runs/{id}/previews/{event}")
async def get_preview(request: Request, id: str, event: Annotated[int, _ID]) -> Response:
    """One of these pictures."""
    watch = await watch_of(request, id)
    return await carefully(request, 404, pictures.preview, watch.place, event)


@router.get("/api/runs/{id}/views")
async def get_views(request: Request, id: str) -> Response:
    """The held-out panoramas with their metrics."""
    watch = await watch_of(request, id)
    return await reply(request, pictures.views, watch.place.folder.database)


@router.get("/api/runs/{id}/views/{number}")
async def get_view(request: Request, id: str, number: Annotated[int, _ID]) -> Response:
    """One of these compared with its render."""
    watch = await watch_of(request, id)
    return await carefully(request, 404, pictures.view, watch.place, number)


@router.get("/api/runs/{id}/point_cloud.ply")
async def get_model(request: Request, id: str) -> Response:
    """The merged model."""
    watch = await watch_of(request, id)
    return await carefully(request, 404, Download.of_model, watch.place)


@router.get("/api/runs/{id}/report.html")
async def get_report(request: Request, id: str, save: bool = False) -> Response:
    """The report."""
    watch = await watch_of(request, id)
    return await carefully(request, 404, Download.of_report, watch.place, save)


@router.get("/api/stream")
async def get_stream(request: Request, run: str | None = None, changes: bool = False) -> Response:
    """What is true, again whenever it is different."""
    board = board_of(request)
    if run is None:
        messages = stream.runs(board)
    else:
        watch, topic = await found(request, run)
        messages = stream.run(board, watch, topic, changes=changes)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(messages, 200, headers, "text/event-stream")


@router.post("/api/runs/{id}/actions")
async def post_action(request: Request, id: str) -> Response:
    """Asks something of the run's driver, or starts one."""
    wish = await body_of(request, Wish)
    watch, _ = await seen(request, id)
    try:
        await board_of(request).call(watch.act, wish.action, wish.block)
    except InputError as error:
        raise HTTPException(409, line_of(request, error)) from error
    except OSError as error:
        raise HTTPException(403, f"the run cannot be written: {error.strerror}") from error
    return json_response(request, encode({"accepted": True}), 202)


@router.post("/api/runs/{id}/viewer")
async def post_viewer(request: Request, id: str) -> Response:
    """Makes a page with the run's model, or a task's, in 3D."""
    model = await body_of(request, Model)
    watch = await watch_of(request, id)
    try:
        key = await pages_of(request).make(watch.place, model.task)
    except (InputError, OSError) as error:
        raise HTTPException(409, line_of(request, error)) from error
    return json_response(request, encode({"url": f"/models/{key}"}))


@router.get("/models/{key}")
async def get_model_page(request: Request, key: str) -> Response:
    """One of these pages."""
    try:
        page = pages_of(request).page(key)
    except InputError as error:
        raise HTTPException(404, str(error)) from error
    headers = {"Content-Security-Policy": PAGE_POLICY, "Cache-Control": "no-store"}
    return FileResponse(page, 200, headers, "text/html; charset=utf-8")
