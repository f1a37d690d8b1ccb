"""Pictures: what records name, previews of tasks and held-out panoramas; and the scene's panoramas.

A run names its scene by a path or a URL, and a run from elsewhere may name any. So a panorama is a plain file
really below a folder that is a scene, an image of at most so many pixels, and a small copy of it is sent. Of
stores only scenes are read that this machine has read before.
"""

import os
import re
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

from fastapi import HTTPException
from fastapi.responses import Response

from panolog.orchestrator.runs.folder import RunFolder, open_below, opened
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.pages.findings import finding_pictures, read_findings
from panolog.orchestrator.watch.views.preparation import picture_paths
from panolog.orchestrator.watch.views.site.photographs import STORE_S, require_size, small_copy
from panolog.scene.errors import InputError, StoreLostError
from panolog.scene.files import natural_key
from panolog.scene.read import check_names, image_folder, model_folder
from panolog.scene.stores.stored_scenes import made_here, whole

_SIZE = 50_000_000  # bytes of a JPEG at most
_COVER = 320  # pixels of the width of a run's picture in the list
_REDUCED = 1024  # pixels of the width of a panorama's copy
_PREVIEW_PATH = re.compile(r"(coarse|(district|blocks|round|repair)/\d{3,9})/previews/\d{6,12}\.jpg")
_JPEG = b"\xff\xd8\xff"
_PNG = b"\x89PNG\r\n\x1a\n"
_one = Lock()  # one copy is made at a time
_VIEWS = 2_000  # held-out panoramas in the list at most


def previews(entry: RunEntry, task: str | None) -> dict[str, Any]:
    """The latest preview of each task, or those of one task which are kept."""
    names = ("task", "iteration", "view", "time", "held_out")
    folder = entry.folder
    events = queries.previews(folder.database, task)
    events = [event for event in events if not _removed(folder, event)]
    return {"previews": [{"event": e["id"]} | {name: e[name] for name in names if name in e} for e in events]}


def _removed(folder: RunFolder, event: dict[str, Any]) -> bool:
    """Whether the driver has removed a preview, see `thinning`; a path that is none of its own is not."""
    path = str(event.get("path"))
    own = _PREVIEW_PATH.fullmatch(path) is not None
    return own and not (folder.root / path).exists()


def views(database: Path) -> dict[str, Any]:
    """The held-out panoramas by name, each with its latest metrics."""
    events = queries.views(database, _VIEWS) if database.exists() else []
    latest = {str(event.get("view")): event for event in reversed(events)}
    return {
        "views": [
            {"number": event["id"], "name": name, "metrics": event.get("metrics")}
            for name, event in sorted(latest.items(), key=lambda item: natural_key(item[0]))
        ]
    }


def preview(entry: RunEntry, number: int) -> Response:
    """A preview by the id of its event. Raises InputError if its file is not below the run or no picture."""
    return _own(entry, entry.folder.root / str(_event(entry, number, "PreviewSaved")["path"]))


def view(entry: RunEntry, number: int) -> Response:
    """A comparison by the id of its event. Raises InputError and ValueError as `preview`."""
    name = str(_event(entry, number, "ViewEvaluated")["view"])
    return _own(entry, entry.folder.picture(name))


def cover(entry: RunEntry, number: int) -> Response:
    """A small picture of a run: the render of a comparison or preview. Raises as `preview`."""
    found = queries.event(entry.folder.database, number, "ViewEvaluated")
    path = (
        entry.folder.picture(str(found["view"]))
        if found
        else entry.folder.root / str(_event(entry, number, "PreviewSaved")["path"])
    )
    with opened(path, entry.folder.root) as file:
        return _response(small_copy(file, path.name, _COVER, "render"))


def of_preparation(entry: RunEntry, name: str) -> Response:
    """A picture that a step of the preparation has made. Raises InputError as `preview`."""
    return _own(entry, picture_paths(entry.folder).get(name))


def of_findings(entry: RunEntry, name: str) -> Response:
    """A picture of the findings. Raises InputError as `preview` and `read_findings`."""
    return _own(entry, finding_pictures(entry.folder, read_findings(entry.folder)).get(name))


def _own(entry: RunEntry, path: Path | None) -> Response:
    if path is None:
        raise HTTPException(404, "there is no such picture")
    data = entry.folder.read(path, _SIZE)
    for kind, begin in (("jpeg", _JPEG), ("png", _PNG)):
        if data.startswith(begin):
            return Response(data, 200, {"Cache-Control": "private, max-age=60"}, f"image/{kind}")
    raise InputError(f"{path.name}: is neither a JPEG nor a PNG")


def _event(entry: RunEntry, number: int, kind: str) -> dict[str, Any]:
    event = queries.event(entry.folder.database, number, kind)
    if event is None:
        raise HTTPException(404, "there is no such picture")
    return event


def open_panorama(scene: Path, name: str) -> BinaryIO:
    """A panorama of a scene.

    Raises InputError if there is no such scene on this machine, or no plain file of that name below it.
    """
    if not (scene.is_absolute() and scene.is_dir()):
        raise InputError(f"the scene {scene} is not on this machine")
    check_names(scene, [name])
    model_folder(scene)  # of a folder that is no scene nothing is served
    folder = image_folder(scene)
    try:
        return os.fdopen(open_below(folder / name, scene), "rb")
    except InputError as error:
        raise InputError(f"{name} is missing in {folder}, or a link that leads out of the scene") from error


def panorama(scene: Path, name: str, width: int = _REDUCED) -> Response:
    """A JPEG of a panorama of a scene, of at most `width` pixels. One is made at a time.

    Raises InputError as `open_panorama`, or if it cannot be decoded.
    """
    with open_panorama(scene, name) as file, _one:
        known = os.fstat(file.fileno())
        version = (known.st_dev, known.st_ino, known.st_mtime_ns, known.st_size)
        return _response(_small(scene, name, width, version))


@lru_cache(maxsize=64)  # of some hundred kilobytes each
def _small(scene: Path, name: str, width: int, _: tuple[int, ...]) -> bytes:
    with open_panorama(scene, name) as file:
        return small_copy(_whole(file, scene, name), name, width)


def _whole(file: BinaryIO, scene: Path, name: str) -> BinaryIO:
    """A panorama of which `file` may be an outline, from the machine's cache or through it.

    Raises InputError if the store does not have it, or not now.
    """
    if not made_here(scene):
        return file
    require_size(os.fstat(file.fileno()).st_size, name)
    try:
        data = whole(image_folder(scene) / name, STORE_S)
    except StoreLostError as error:
        raise InputError(str(error)) from error
    return file if data is None else BytesIO(data)


def _response(data: bytes) -> Response:
    return Response(data, 200, {"Cache-Control": "private, max-age=60"}, "image/jpeg")
