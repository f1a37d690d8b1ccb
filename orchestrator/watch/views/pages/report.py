"""report.html: the page of a run with a snapshot of its data, as one self-contained file to read or to send.

All of it comes from the run folder, so it can be made at any time, also of a copy.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder, command_line, is_below
from panolog.orchestrator.runs.info import read_history, read_info
from panolog.orchestrator.runs.records import Noticed, Part, Progressed, Record
from panolog.orchestrator.watch.views.exposures import exposure_curve
from panolog.orchestrator.watch.views.history import History
from panolog.orchestrator.watch.views.pages.findings import (
    Findings,
    finding_pictures,
    findings_version,
    read_findings,
)
from panolog.orchestrator.watch.views.pages.shell import RUN, data_url, write_snapshot
from panolog.orchestrator.watch.views.plan_page import cameras_of, map_of, plan_of, scores_of, view_camera
from panolog.orchestrator.watch.views.preparation import (
    PreparationView,
    picture_paths,
    version_of,
    view_preparation,
)
from panolog.orchestrator.watch.views.queries import Filter, events, series, spread
from panolog.orchestrator.watch.views.run_view import RunView, view_run
from panolog.orchestrator.watch.views.site.photographs import WIDE, small_copy
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import natural_key
from panolog.workers.tasks import Stage, TaskId

_ID = "report"  # what the page calls its run
_PATH = f"runs/{_ID}"
_LINES = 24  # blocks that have curves: the first ones
_POINTS = 300  # of a curve
_EVENTS = 1_000  # the latest
_PICTURES = 12  # held-out panoramas that are shown, from the worst to the best
_INSTALL = "pip install"  # in notices for who has made the run, and not for who reads its report
_SCORES = 100_000  # of all cameras, up to which each camera and block has its own


def write_report(folder: RunFolder, output: Path | None = None, *, running: bool | None = None) -> Path:
    """Writes the report of a run in its present state, atomically; RUN/report.html without `output`.

    Args: running, whether a driver works on the run; by default whether one holds its lock.
    Raises InputError if the folder is no run or its files are damaged; OSError if it cannot be written.
    """
    path = output or folder.report
    running = lock.held(folder.lock) if running is None else running
    history = History.of(read_history(folder))
    info = read_info(folder).model_dump(mode="json")
    prepared = view_preparation(folder, history.state, running=running)
    view = view_run(history, info, running=running, root=folder.root, preparation=prepared)
    answers = dict(_answers(folder, view, read_findings(folder)))
    message = _message(folder, view, next_to=RunFolder(path.parent).place == folder.place)
    write_snapshot(path, RUN, answers, {"run": message}, _own_paths(folder, info, prepared))
    return path


def report_or_notice(folder: RunFolder) -> list[Record]:
    """Writes the report of a run that has ended, while its driver still holds the lock.

    A failure becomes a notice.
    """
    try:
        write_report(folder, running=False)
    except (OSError, PanologError) as error:
        return [
            Noticed(
                Part.REPORT, f"not written: {error}; `{command_line('report', folder.root)}` tries it again"
            )
        ]
    return []


def _own_paths(folder: RunFolder, info: dict[str, Any], prepared: PreparationView | None) -> list[str]:
    """Paths of this machine that a reader elsewhere needs to know no more of than their names."""
    found = [
        str(folder.place),
        str(info["scene"]["path"]),
        *([prepared.source, *prepared.others] if prepared else []),
    ]
    return sorted((path for path in found if Path(path).is_absolute()), key=len, reverse=True)


def _message(folder: RunFolder, view: RunView, *, next_to: bool) -> dict[str, Any]:
    """The message of the stream with all about the run: RunPage of the dashboard.

    Args: next_to, whether the report is in the run's folder, so that links lead to what is there.
    """
    root, summary = folder.place, view.summary
    notices = tuple(notice for notice in summary.notices if _INSTALL not in notice.message)
    return dict(view) | {
        "summary": summary.model_copy(update={"notices": notices}),
        "id": _ID,
        "name": root.name,
        "path": root.name,
        "actions": {"allowed": False, "why": None, "available": (), "failed": None},
        "result": {
            "model": next_to and folder.point_cloud.is_file(),
            "report": False,
            "view": next_to and folder.page.is_file(),
            "sog": next_to and folder.sog.is_file(),
            "exposure": version_of(folder.exposure),
            "map": folder.known_plan.exists(),
            "findings": findings_version(folder),
        },
    }


def _answers(folder: RunFolder, view: RunView, found: Findings) -> Iterator[tuple[str, Any]]:
    """What the page requests, by its paths below /api."""
    yield f"{_PATH}/findings", found
    for name, path in finding_pictures(folder, found).items():
        yield f"{_PATH}/findings/{name}", _picture(path)
    for picture in view.preparation.pictures if view.preparation else ():
        made = picture_paths(folder)[picture.name]
        yield f"{_PATH}/preparation/{picture.name}?{picture.version}", _picture(made)
    if folder.exposure.is_file():
        yield f"{_PATH}/exposure", exposure_curve(folder)
    if folder.known_plan.exists():
        yield f"{_PATH}/map", map_of(folder)
        yield from _cameras(folder)
    if folder.database.exists():
        without = Filter(without=frozenset({Progressed.__name__}))
        latest = events(folder.database, without, _EVENTS)
        shown = [event for event in latest["events"] if _INSTALL not in str(event.get("message"))]
        yield f"{_PATH}/events", {"events": shown, "more": False, "next": None}
        yield from _curves(folder, view)
    yield from _held_out(folder, found)


def _cameras(folder: RunFolder) -> Iterator[tuple[str, Any]]:
    """The cameras of a plan, and the blocks with theirs; nothing of a large one."""
    plan = plan_of(folder)
    if len(plan.rows) * plan.grid.count > _SCORES or (scores := scores_of(folder, plan)) is None:
        return
    for k, row in enumerate(plan.rows):
        yield f"{_PATH}/camera/{row}", view_camera(plan, k, scores, "a report has none of the scene")
    for block in range(plan.grid.count):
        yield f"{_PATH}/block/{block}", cameras_of(plan, block)


def _curves(folder: RunFolder, view: RunView) -> Iterator[tuple[str, Any]]:
    """The curves of Stage I and of the first tasks of other stages."""
    tasks = [TaskId.parse(task.name) for task in view.summary.tasks]
    for stage in Stage:
        for task in [task for task in tasks if task.stage is stage and stage.trains][:_LINES]:
            path = f"{_PATH}/series?task={quote(str(task), safe='')}"
            yield path, series(folder.database, str(task), _POINTS)


def _held_out(folder: RunFolder, found: Findings) -> Iterator[tuple[str, Any]]:
    """Some held-out panoramas with their renders and metrics."""
    metrics = found.metrics.views if found.metrics else {}
    paths = {name: folder.picture(name).resolve() for name in metrics}
    there = [name for name, path in paths.items() if is_below(path, folder.images)]
    ranked = sorted(there, key=lambda name: metrics[name].get("psnr") or 0.0)
    pictures = {name: _picture(paths[name]) for name in sorted(spread(ranked, _PICTURES), key=natural_key)}
    shown = [name for name, url in pictures.items() if url is not None]
    views = [{"number": number, "name": name, "metrics": metrics[name]} for number, name in enumerate(shown)]
    yield f"{_PATH}/views", {"views": views}
    yield f"{_PATH}/previews", {"previews": []}
    for number, name in enumerate(shown):
        yield f"{_PATH}/views/{number}", pictures[name]


def _picture(path: Path) -> str | None:
    """A picture as a URL: a PNG as it is, others as a small JPEG; None if it is no picture."""
    if path.suffix == ".png":
        return data_url("image/png", path.read_bytes())
    try:
        with path.open("rb") as file:
            return data_url("image/jpeg", small_copy(file, path.name, WIDE))
    except InputError:
        return None
