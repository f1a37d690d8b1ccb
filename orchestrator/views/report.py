"""report.html: a run as one self-contained page, to read or to send.

All of it comes from the run folder, so it can be made at any time, also of a copy. The template escapes its
values: names of scenes and panoramas, notices and errors are untrusted text.
"""

import base64
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import jinja2
from markupsafe import Markup

from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.run.records import Noticed, Part, Record
from panolog.orchestrator.run.store import read_milestones
from panolog.orchestrator.run.units import duration, gib
from panolog.orchestrator.views.figures import curve_figure, map_figure
from panolog.orchestrator.views.history import History
from panolog.orchestrator.views.palette import block_color
from panolog.orchestrator.views.plan_map import block_statuses, read_points
from panolog.orchestrator.views.queries import series
from panolog.orchestrator.views.run_view import view_run
from panolog.orchestrator.views.summary import METRICS, Summary, metric_text
from panolog.partition.plan import read_plan
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import write_bytes
from panolog.workers.tasks import COARSE, Stage, TaskId

_TEMPLATE = Path(__file__).with_name("report.html.j2")
_CURVES = {  # titles by the names of the series; with True on a log scale
    "loss": ("Training loss", True),
    "psnr": ("PSNR over training views, dB", False),
    "gaussians": ("Gaussians", False),
    "rate": ("Iterations per second", False),
}
_BELOW = {"legend": {"orientation": "h", "y": -0.28}}  # the axis' title, which a low chart puts there too
_LINES = 24  # blocks that have curves: the first ones
_POINTS = 300  # of a curve
_PICTURES = 12  # held-out panoramas that are shown, from the worst to the best
_WIDTH, _QUALITY = 1024, 82  # pixels and JPEG quality of these
_ROWS = 2_000  # of a table


def write_report(folder: RunFolder, output: Path | None = None) -> Path:
    """Writes the report of a run in its present state, atomically; RUN/report.html without `output`.

    Raises InputError if the folder is no run or its files are damaged; OSError if it cannot be written.
    """
    path = output or folder.report
    write_bytes(path, _render(_content(folder)).encode())
    return path


def report_or_notice(folder: RunFolder) -> list[Record]:
    """Writes the report of a run that has ended; a failure becomes a notice."""
    try:
        write_report(folder)
    except (OSError, PanologError) as error:
        return [Noticed(Part.REPORT, f"not written: {error}; `panolog report {folder.root}` tries it again")]
    return []


def _render(content: Mapping[str, Any]) -> str:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "duration": duration,
        "size": gib,
        "local": _local,
        "metric": _metric,
        "value": _value,
    }
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(content, plotly=Markup(_plotly()))


def _plotly() -> str:
    """plotly.min.js of its Python package."""
    return (files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def _content(folder: RunFolder) -> dict[str, Any]:
    """The values of the template."""
    info = read_info(folder).model_dump(mode="json")
    history = History.of(read_milestones(folder.database) if folder.database.exists() else ())
    view = view_run(history, info, running=lock.held(folder.lock))
    evaluation, tasks = _evaluation(folder), {task.name: task for task in view.summary.tasks}
    return {
        "name": folder.root.absolute().name,
        "info": info,
        "state": view.summary,
        "stages": view.stages,
        "blocks": [(block, tasks.get(str(TaskId.block(block.block)))) for block in view.summary.blocks],
        "metrics": METRICS,
        "evaluation": evaluation,
        "pictures": list(_pictures(folder, evaluation)),
        "figures": _figures(folder, view.summary),
        "rows": _ROWS,
        "lines": _LINES,
        "config": view.config,
        "changed": [setting for setting in view.config if setting.changed],
        "made": time.time(),
    }


def _evaluation(folder: RunFolder) -> dict[str, Any]:
    """The content of metrics.json; empty before the evaluation."""
    try:
        content = json.loads(folder.metrics.read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise InputError(f"{folder.metrics}: is not JSON: {error}") from error
    return content if isinstance(content, dict) else {}


def _figures(folder: RunFolder, summary: Summary) -> dict[str, Any]:
    """The map and the curves, by the id of their element."""
    figures = dict[str, Any]()
    if folder.plan.exists():
        points = read_points(folder.model(COARSE))
        figures["map"] = map_figure(read_plan(folder.plan), points, block_statuses(summary))
    tasks = [TaskId.parse(task.name) for task in summary.tasks]
    blocks = [task for task in tasks if task.stage is Stage.BLOCK][:_LINES]
    names = [str(task) for task in (COARSE, *blocks) if task in tasks]
    curves = {name: series(folder.database, name, _POINTS) for name in names}
    count = len(summary.blocks)
    colors = {str(block): block_color(block.number, count) for block in blocks}
    for kind, (title, log) in _CURVES.items():
        lines = {name: found[kind] for name, found in curves.items() if kind in found}
        if lines:
            figure = curve_figure(lines, title, colors=colors | {str(COARSE): "#22272e"}, log=log)
            figures[kind] = {"data": figure["data"], "layout": figure["layout"] | _BELOW}
    return figures


def _pictures(folder: RunFolder, evaluation: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Some held-out panoramas with their renders and metrics."""
    views = evaluation.get("views", {})
    paths = {name: (folder.images / name).with_suffix(".jpg").resolve() for name in views}
    inside = folder.images.resolve()
    there = [name for name, path in paths.items() if path.is_relative_to(inside) and path.is_file()]
    ranked = sorted(there, key=lambda name: views[name].get("psnr") or 0.0)
    for name in _spread(ranked, _PICTURES):
        if (jpeg := _shrunk(paths[name])) is not None:
            data = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
            yield {"name": name, "metrics": views[name], "data": data}


def _spread(names: Sequence[str], most: int) -> list[str]:
    """At most `most` of the names, evenly spaced, both ends included."""
    if len(names) <= most:
        return list(names)
    return [names[round(i * (len(names) - 1) / (most - 1))] for i in range(most)]


def _shrunk(path: Path) -> bytes | None:
    """A picture as a JPEG of at most _WIDTH pixels; None if it is none."""
    picture = cv2.imread(str(path))
    if picture is None:
        return None
    height, width = picture.shape[:2]
    if width > _WIDTH:
        size = (_WIDTH, round(height * _WIDTH / width))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def _local(seconds: float) -> str:
    """A time in UTC: readers may be in another time zone."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(seconds))


def _metric(value: float | None, name: str) -> str:
    """A metric, or a dash."""
    return "–" if value is None else metric_text(value, name)


def _value(value: Any) -> str:
    """A number or a setting as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
