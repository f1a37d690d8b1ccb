"""Pictures that records name: previews of training views, and held-out panoramas."""

from pathlib import Path
from typing import Any

from fastapi import HTTPException
from fastapi.responses import Response

from panolog.orchestrator.dashboard.discovery import RunEntry, read_below
from panolog.orchestrator.views import queries
from panolog.scene.errors import InputError

_SIZE = 50_000_000  # bytes of a JPEG at most
_JPEG = b"\xff\xd8\xff"
_VIEWS = 2_000  # held-out panoramas in the list at most


def previews(database: Path, task: str | None) -> dict[str, Any]:
    """The latest preview of each task, or those of one task."""
    names = ("task", "iteration", "view", "time")
    events = queries.pictures(database, "PreviewSaved", task)
    return {"previews": [{"event": e["id"]} | {name: e.get(name) for name in names} for e in events]}


def views(database: Path) -> dict[str, Any]:
    """The held-out panoramas by name, each with its latest metrics."""
    events = queries.pictures(database, "ViewEvaluated", "eval", _VIEWS)
    latest = {str(event.get("view")): event for event in reversed(events)}
    return {
        "views": [
            {"number": event["id"], "name": name, "metrics": event.get("metrics")}
            for name, event in sorted(latest.items())
        ]
    }


def preview(entry: RunEntry, number: int) -> Response:
    """A preview by the id of its event. Raises InputError if its file is not below the run or no JPEG."""
    return _jpeg(entry, entry.folder.root / str(_event(entry, number, "PreviewSaved")["path"]))


def view(entry: RunEntry, number: int) -> Response:
    """A comparison by the id of its event. Raises InputError and ValueError as `preview`."""
    name = str(_event(entry, number, "ViewEvaluated")["view"])
    return _jpeg(entry, (entry.folder.images / name).with_suffix(".jpg"))


def _event(entry: RunEntry, number: int, kind: str) -> dict[str, Any]:
    event = queries.event(entry.folder.database, number, kind)
    if event is None:
        raise HTTPException(404, "there is no such picture")
    return event


def _jpeg(entry: RunEntry, path: Path) -> Response:
    data = read_below(path, entry.folder.root, _SIZE)
    if not data.startswith(_JPEG):
        raise InputError(f"{path.name}: is not a JPEG")
    return Response(data, 200, {"Cache-Control": "private, max-age=60"}, "image/jpeg")
