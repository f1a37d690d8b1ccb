"""The routes of what is made of models on request: pages in 3D, and files to save. See `api`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import Response

from panolog.export.site.write import DESCRIPTION
from panolog.orchestrator.watch.dashboard.api import scene_of
from panolog.orchestrator.watch.dashboard.dependencies import (
    Body,
    Registry,
    Run,
    body_of,
    fresh_watch,
    respond,
)
from panolog.orchestrator.watch.dashboard.models.downloads import Downloads, Kind
from panolog.orchestrator.watch.dashboard.models.pages import ModelPages, page_policy
from panolog.orchestrator.watch.dashboard.registry import RunRegistry
from panolog.orchestrator.watch.dashboard.responses import json_response
from panolog.orchestrator.watch.dashboard.watch import Watch, error_line
from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.plan_page import plan_of
from panolog.scene.errors import InputError

router = APIRouter()


class ViewerRequest(Body):
    """The body of a POST to /viewer."""

    task: str | None = None
    camera: str | None = None


class DownloadRequest(Body):
    """The body of a POST to /downloads."""

    kind: Kind


@router.post("/api/runs/{id}/viewer")
async def post_viewer(request: Request, registry: Registry, id: str) -> Response:
    """Makes a page with the run's model, or a task's, in 3D."""
    body = await body_of(request, ViewerRequest)
    watch = await fresh_watch(registry, id)
    pages: ModelPages = request.app.state.pages
    with _refusals(registry):
        if body.camera is not None:
            await registry.call(_require_camera, watch, body.camera)
        key = await pages.make(watch.entry, body.task, _scene_folder(watch))
    start = "" if body.camera is None else f"#camera={quote(body.camera, safe='')}"
    return json_response(request, encode({"url": f"/models/{key}/{start}"}))


@router.post("/api/runs/{id}/downloads")
async def post_download(request: Request, registry: Registry, id: str) -> Response:
    """Makes a file of the run's model."""
    body = await body_of(request, DownloadRequest)
    watch = await fresh_watch(registry, id)
    downloads: Downloads = request.app.state.downloads
    with _refusals(registry):
        await downloads.make(watch.entry, body.kind)
    return json_response(request, encode({"url": f"/api/runs/{id}/downloads/{body.kind}"}))


@router.get("/api/runs/{id}/downloads/{kind}")
async def get_download(request: Request, run: Run, kind: Kind) -> Response:
    """A file of the run's model that was made."""
    downloads: Downloads = request.app.state.downloads
    return await respond(request, 404, downloads.file, run.entry, kind)


@router.get("/models/{key}/{path:path}")
async def get_model_page(request: Request, key: str, path: str) -> Response:
    """A file of a page with a model in 3D, or a photograph."""
    pages: ModelPages = request.app.state.pages
    if path == DESCRIPTION:
        await pages.renew(key)
    policy = page_policy(request.headers.get("host", ""), key)
    return await respond(request, 404, pages.file, key, path, policy)


@contextmanager
def _refusals(registry: RunRegistry) -> Iterator[None]:
    """Turns what cannot be made of a run into 409, with one line."""
    try:
        yield
    except (InputError, OSError) as error:
        raise HTTPException(409, error_line(error, registry.root)) from error


def _require_camera(run: Watch, name: str) -> None:
    """Raises InputError if the plan has no panorama of that name, or cannot be read."""
    if name not in plan_of(run.entry.folder).names:
        raise InputError("the plan of this run has no such panorama")


def _scene_folder(run: Watch) -> Path | None:
    """Where the photographs of a run are, if that is on this machine."""
    try:
        scene = scene_of(run)
    except InputError:
        return None
    return scene if scene.is_absolute() and scene.is_dir() else None
