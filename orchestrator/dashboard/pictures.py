"""Pictures that records tell of: of the run in progress, and of held-out panoramas."""

from pathlib import Path
from typing import Any

from fastapi import HTTPException
from fastapi.responses import Response

from panolog.orchestrator.dashboard.places import Place, read_below
from panolog.orchestrator.views import queries
from panolog.scene.errors import InputError

_SIZE = 50_000_000  # bytes of a JPEG at most
_JPEG = b"\xff\xd8\xff"
_VIEWS = 2_000  # held-out panoramas that are listed at most


def previews(database: Path, task: str | None) -> dict[str, Any]:
    """The latest preview of each task, or those of one task."""
    names = ("task", "iteration", "view", "time")
    events = queries.pictures(database, "PreviewSaved", task)
    return {"previews": [{"event": e["id"]} | {name: e.get(name) for name in names} for e in events]}


def views(database: Path) -> dict[str, Any]:
    """The held-out panoramas by name, as they were measured last."""
    events = queries.pictures(database, "ViewEvaluated", "eval", _VIEWS)
    latest = {str(event.get("view")): event for event in reversed(events)}
    return {
        "views": [
            {"number": event["id"], "name": name, "metrics": event.get("metrics")}
            for name, event in sorted(latest.items())
        ]
    }


def preview(place: Place, number: int) -> Response:
    """A preview by the id of its event. Raises InputError if its file is none of the run or no JPEG."""
    return _jpeg(place, place.folder.root / str(_event(place, number, "PreviewSaved")["path"]))


def view(place: Place, number: int) -> Response:
    """A comparison by the id of its event. Raises InputError and ValueError as `preview`."""
    name = str(_event(place, number, "ViewEvaluated")["view"])
    return _jpeg(place, (place.folder.images / name).with_suffix(".jpg"))


def _event(place: Place, number: int, kind: str) -> dict[str, Any]:
    event = queries.event(place.folder.database, number, kind)
    if event is None:
        raise HTTPException(404, "there is no such picture")
    return event


def _jpeg(place: Place, path: Path) -> Response:
    data = read_below(path, place.folder.root, _SIZE)
    if not data.startswith(_JPEG):
        raise InputError(f"{path.name}: is no JPEG")
    return Response(data, 200, {"Cache-Control": "private, max-age=60"}, "image/jpeg")
