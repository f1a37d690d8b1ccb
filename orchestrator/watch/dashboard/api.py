"""The routes: the contract between the server and its pages, or any other program.

All JSON, typed in `messages`; times in seconds since the epoch, sizes in bytes, rates per second. A run is
named by an id of 16 hex digits: no path ever comes from a client. An error is {"error": one line} with 403
(see `guard`), 404, 409 (not possible now), 422 (a bad parameter) or 503 (the run cannot be read at present).

GET /, /runs/{id}, /compare, /static/…, /vendor/… pages, scripts and styles
GET /api/runs                         RunList
GET /api/runs/{id}                    RunPage
GET /api/runs/{id}/map                see `plan_map.map_figure`; all its blocks are waiting
GET /api/runs/{id}/camera/{row}       CameraView
GET /api/runs/{id}/camera/{row}/panorama
                                      JPEG, the panorama of the scene at a width of at most 1,024 pixels
GET /api/runs/{id}/block/{number}     BlockCameras
GET /api/runs/{id}/series?task=&points=
    {"loss": Series, "psnr", "gaussians", "rate", "memory", "rate/means"…}: at most `points` (600) of each
GET /api/runs/{id}/events?before=&after=&limit=&type=&task=&text=
    EventList, newest first, at most `limit` (200). `type` may be repeated; with "-" before it is left out. If
    "more", continue with before="next": a search for a text can return few events or none and still have more
    records to search.
GET /api/runs/{id}/previews[?task=]   PreviewList: the latest of each task, or all of one, newest first
GET /api/runs/{id}/previews/{event}   JPEG, the render above the photograph
GET /api/runs/{id}/views              HeldOutViews
GET /api/runs/{id}/views/{number}     JPEG, the render above the photograph
GET /api/runs/{id}/cover/{event}      JPEG, the render of such a picture, small: `RunRow.cover` names one
GET /api/runs/{id}/preparation/{name} PNG or JPEG, what a step of the preparation has made: `PictureView.name`
GET /api/runs/{id}/exposure           ExposureCurve
GET /api/runs/{id}/findings           Findings: metrics of held-out panoramas, seams, refined poses, movers
GET /api/runs/{id}/findings/{name}    PNG or JPEG, one of `Findings.pictures`
GET /api/runs/{id}/point_cloud.ply    the model, to save
GET /api/runs/{id}/downloads/{kind}   a file of it that was made, to save
GET /api/runs/{id}/view.html          the model in 3D as one file, in a sandbox of its own
GET /api/runs/{id}/report.html[?save=1]the report, to read in a sandbox of its own, or to save
GET /api/compare?run=ID&run=ID…       Comparison of two to eight runs; of one that cannot be read the error
GET /api/compare/curves?run=ID&run=ID…
                                      CurvesOfRuns
GET /api/stream[?run=ID][&changes=1]
    Server-sent events; without `run` of the list. The first message is complete: "runs" (RunList) or "run"
    (RunPage); again whenever it has changed, at most twice a second. "events" (EventList) has the records
    since the connection began, at most 200 and of progress only the latest of each task. "gone": {"error"}:
    the run cannot be read (any more). With changes=1 "changes" (RunChanges) takes the place of all "run" but
    the first, unless most has changed.
POST /api/runs/{id}/actions           {"action": "stop"|"resume"|"retry"|"pause"|"unpause"|"release", "block":
                                      n|null, "node": null|host or begin of an id} → 202 {"accepted": true}
POST /api/queue                       {"action": "move"|"remove"|"retry", "entry": n, "before": n|null} → 202
                                      {"accepted": true}; `before` is where to move, null = to the end
POST /api/runs/{id}/viewer            {"task": null|"coarse"|"block/003", "camera": null|name} → {"url"} of a
                                      page with the model in 3D, which takes seconds to make. It begins at the
                                      panorama of that name in the plan: `PlanCamera.name`
POST /api/runs/{id}/downloads         {"kind": "sog"|"spz"|"ply"|"html"} → {"url"} of a file of the model,
                                      which takes seconds to make
GET /models/{key}/…                   its files, and photographs; the key grants them

A POST needs `X-PanoLOG: 1` and the content type application/json.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Annotated, Literal

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import Response, StreamingResponse
from pydantic import Field

from panolog.orchestrator.runs.folder import RunFolder, part_of
from panolog.orchestrator.watch.dashboard import pictures, stream
from panolog.orchestrator.watch.dashboard.dependencies import (
    Body,
    ComparedRuns,
    Registry,
    Run,
    body_of,
    find_run,
    fresh_watch,
    read_watch,
    respond,
    respond_json,
)
from panolog.orchestrator.watch.dashboard.queues.panel import QueueAction
from panolog.orchestrator.watch.dashboard.responses import (
    json_response,
    model_download,
    page_download,
    report_download,
)
from panolog.orchestrator.watch.dashboard.watch import Watch, error_line
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.curves import curves_of
from panolog.orchestrator.watch.views.comparison.reading import ReadRun, UnreadRun
from panolog.orchestrator.watch.views.comparison.schema import Comparison
from panolog.orchestrator.watch.views.exposures import exposure_curve
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.pages.findings import read_findings
from panolog.orchestrator.watch.views.plan_page import (
    CameraView,
    cameras_of,
    map_of,
    plan_of,
    scores_of,
    view_camera,
)
from panolog.scene.errors import InputError
from panolog.scene.stores.stored_scenes import local_folder, made_here
from panolog.scene.stores.url import is_url
from panolog.workers.tasks import COARSE

router = APIRouter()
_one_map = Lock()  # one is made at a time
_EventId = Annotated[int, Field(ge=0, lt=2**63)]


class ActionRequest(Body):
    """The body of a POST to /actions."""

    action: Literal["stop", "resume", "retry", "pause", "unpause", "release"]
    block: int | None = None
    node: Annotated[str, Field(max_length=255)] | None = None


class QueueRequest(Body):
    """The body of a POST to /queue."""

    action: QueueAction
    entry: Annotated[int, Field(ge=1, lt=2**63)]
    before: Annotated[int, Field(ge=1, lt=2**63)] | None = None


@router.get("/api/runs")
async def get_runs(request: Request, registry: Registry) -> Response:
    """The list."""
    await registry.list.refresh()
    return json_response(request, registry.data)


@router.get("/api/runs/{id}")
async def get_run(request: Request, registry: Registry, run: Run) -> Response:
    """All about one run."""
    return await registry.call(json_response, request, run.snapshot.data)


@router.get("/api/runs/{id}/map")
async def get_map(request: Request, run: Run) -> Response:
    """The plan of a run from above."""
    return await respond(request, 404, lambda: json_response(request, encoded_map(run.entry.folder)))


@router.get("/api/runs/{id}/camera/{row}")
async def get_camera(request: Request, run: Run, row: int) -> Response:
    """One training camera of its plan."""
    return await respond_json(request, _camera_view, run, row, status=404)


@router.get("/api/runs/{id}/camera/{row}/panorama")
async def get_panorama(request: Request, run: Run, row: int) -> Response:
    """The picture of a panorama."""
    return await respond(request, 404, _panorama, run, row)


@router.get("/api/runs/{id}/block/{number}")
async def get_block(request: Request, run: Run, number: int) -> Response:
    """The cameras of a block of its plan."""
    return await respond_json(request, lambda: cameras_of(plan_of(run.entry.folder), number), status=404)


def encoded_map(folder: RunFolder) -> bytes:
    """The map from above, as JSON, kept as long as it stays as it is; pages draw the status of blocks.

    Raises InputError if there is no plan yet or it cannot be read.
    """
    outlined = (folder.outline_points, folder.outline_fixes)
    files = (folder.known_plan, folder.model(COARSE), *outlined, folder.seams)
    stats = [path.stat() for path in files if path.exists()]
    with _one_map:
        return _encoded(folder, tuple((stat.st_mtime_ns, stat.st_size) for stat in stats))


@lru_cache(maxsize=4)  # of about a megabyte each
def _encoded(folder: RunFolder, _: tuple[tuple[int, int], ...]) -> bytes:
    return encode(map_of(folder))


def _camera_view(run: Watch, row: int) -> CameraView | None:
    plan, why = plan_of(run.entry.folder), None
    if row not in plan.rows:
        return None
    k = plan.rows.index(row)
    try:
        pictures.open_panorama(scene_of(run), plan.names[k]).close()
    except InputError as error:
        why = str(error)
    return view_camera(plan, k, scores_of(run.entry.folder, plan), why)


def _panorama(run: Watch, row: int) -> Response:
    plan = plan_of(run.entry.folder)
    if row not in plan.rows:
        raise InputError("the plan of this run has no such panorama")
    return pictures.panorama(scene_of(run), plan.names[plan.rows.index(row)])


def scene_of(run: Watch) -> Path:
    """The folder that the run has recorded, or the outline of the URL.

    Raises InputError if it has recorded none, or this machine has not read what is at the URL.
    """
    path = part_of(run.snapshot.page.info, "scene").get("path") if run.snapshot.page else None
    if not isinstance(path, str) or "\0" in path:
        raise InputError("run.json names no scene")
    folder = local_folder(path)
    if is_url(path) and not made_here(folder):
        raise InputError(f"the scene {path} is in a store, and this machine has not read it yet")
    return folder


@router.get("/api/runs/{id}/series")
async def get_series(
    request: Request, run: Run, task: str, points: Annotated[int, Query(ge=2, le=5_000)] = 600
) -> Response:
    """The curves of a task."""
    return await respond_json(request, queries.series, run.database, task, points)


@router.get("/api/runs/{id}/events")
async def get_events(
    request: Request,
    run: Run,
    before: _EventId | None = None,
    after: _EventId = 0,
    limit: Annotated[int, Query(ge=1, le=1_000)] = 200,
    type: Annotated[list[str] | None, Query(max_length=50)] = None,
    task: str | None = None,
    text: Annotated[str, Query(max_length=200)] = "",
) -> Response:
    """A page of its history."""
    types = frozenset(filter(None, type or ()))
    without = frozenset(name[1:] for name in types if name.startswith("-"))
    only = frozenset(name for name in types if not name.startswith("-"))
    wanted = queries.Filter(before, after, only, without, task or None, text)
    return await respond_json(request, queries.events, run.database, wanted, limit)


@router.get("/api/runs/{id}/previews")
async def get_previews(request: Request, run: Run, task: str | None = None) -> Response:
    """Which previews of tasks there are."""
    return await respond_json(request, pictures.previews, run.entry, task)


@router.get("/api/runs/{id}/previews/{event}")
async def get_preview(request: Request, run: Run, event: _EventId) -> Response:
    """One of these pictures."""
    return await respond(request, 404, pictures.preview, run.entry, event)


@router.get("/api/runs/{id}/views")
async def get_views(request: Request, run: Run) -> Response:
    """The held-out panoramas with their metrics."""
    return await respond_json(request, pictures.views, run.database)


@router.get("/api/runs/{id}/views/{number}")
async def get_view(request: Request, run: Run, number: _EventId) -> Response:
    """One of these compared with its render."""
    return await respond(request, 404, pictures.view, run.entry, number)


@router.get("/api/runs/{id}/cover/{event}")
async def get_cover(request: Request, run: Run, event: _EventId) -> Response:
    """The small picture of a run in the list."""
    return await respond(request, 404, pictures.cover, run.entry, event)


@router.get("/api/runs/{id}/preparation/{name}")
async def get_preparation_picture(request: Request, run: Run, name: str) -> Response:
    """What a step of the preparation has made."""
    return await respond(request, 404, pictures.of_preparation, run.entry, name)


@router.get("/api/runs/{id}/exposure")
async def get_exposure(request: Request, run: Run) -> Response:
    """How bright each training panorama is."""
    return await respond_json(request, exposure_curve, run.entry.folder, status=404)


@router.get("/api/runs/{id}/findings")
async def get_findings(request: Request, run: Run) -> Response:
    """What was measured."""
    return await respond_json(request, read_findings, run.entry.folder, status=404)


@router.get("/api/runs/{id}/findings/{name}")
async def get_finding_picture(request: Request, run: Run, name: str) -> Response:
    """One of its pictures."""
    return await respond(request, 404, pictures.of_findings, run.entry, name)


@router.get("/api/runs/{id}/point_cloud.ply")
async def get_model(request: Request, run: Run) -> Response:
    """The merged model."""
    return await respond(request, 404, model_download, run.entry)


@router.get("/api/runs/{id}/view.html")
async def get_view_page(request: Request, run: Run) -> Response:
    """The model of a run in 3D, as one page."""
    return await respond(request, 404, page_download, run.entry)


@router.get("/api/runs/{id}/report.html")
async def get_report(request: Request, run: Run, save: bool = False) -> Response:
    """The report."""
    return await respond(request, 404, report_download, run.entry, save)


@router.get("/api/compare")
async def get_comparison(request: Request, runs: ComparedRuns) -> Response:
    """Runs side by side."""
    return await respond_json(request, _comparison, runs)


@router.get("/api/compare/curves")
async def get_compared_curves(request: Request, runs: ComparedRuns) -> Response:
    """The curves of runs on one axis."""
    return await respond_json(request, lambda: curves_of([read_watch(run) for run in runs]))


def _comparison(runs: Sequence[Watch | UnreadRun]) -> Comparison:
    """The comparison with the URLs of its pictures."""
    found = [read_watch(run) for run in runs]
    views = {
        run.id: pictures.views(run.folder.database)["views"] for run in found if isinstance(run, ReadRun)
    }
    numbers = {id: {view["name"]: view["number"] for view in every} for id, every in views.items()}

    def url(run: ReadRun, view: str) -> str | None:
        number = numbers[run.id].get(view)
        return None if number is None else f"/api/runs/{run.id}/views/{number}"

    return compare(found, url)


@router.get("/api/stream")
async def get_stream(
    request: Request, registry: Registry, run: str | None = None, changes: bool = False
) -> Response:
    """The list or a run, again whenever it has changed."""
    if run is None:
        messages = stream.runs(registry)
    else:
        watch, topic = await find_run(registry, run)
        begin = request.app.state.pages.begin
        messages = stream.run(registry, watch, topic, begin, changes=changes)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(messages, 200, headers, "text/event-stream")


@router.post("/api/runs/{id}/actions")
async def post_action(request: Request, registry: Registry, id: str) -> Response:
    """Requests something of the run's driver, or starts one."""
    body = await body_of(request, ActionRequest)
    watch = await fresh_watch(registry, id)
    try:
        await registry.call(watch.act, body.action, body.block, body.node)
    except InputError as error:
        raise HTTPException(409, error_line(error, registry.root)) from error
    except OSError as error:
        raise HTTPException(403, f"the run cannot be written: {error.strerror}") from error
    return json_response(request, encode({"accepted": True}), 202)


@router.post("/api/queue")
async def post_queue(request: Request, registry: Registry) -> Response:
    """Changes the queue."""
    body = await body_of(request, QueueRequest)
    try:
        await registry.call(registry.queue.act, body.action, body.entry, body.before)
    except InputError as error:
        raise HTTPException(409, error_line(error, registry.root)) from error
    await registry.list.refresh()
    return json_response(request, encode({"accepted": True}), 202)
