"""report.html: a run as one self-contained page, to read or to send.

All of it comes from the run folder, so it can be made at any time, also of a copy. The template escapes its
values: names of scenes and panoramas, notices and errors are untrusted text. Charts and pictures are shown by
the scripts and style sheets of the dashboard.
"""

import base64
import json
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import cv2
import jinja2
from markupsafe import Markup
from pydantic import TypeAdapter

from panolog.orchestrator.run import lock
from panolog.orchestrator.run.folder import RunFolder, command_line
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.run.records import Noticed, Part, Record
from panolog.orchestrator.run.state import Status
from panolog.orchestrator.run.store import read_milestones
from panolog.orchestrator.run.units import duration, gib
from panolog.orchestrator.views.exposures import exposure_curve
from panolog.orchestrator.views.figures import map_figure
from panolog.orchestrator.views.history import History
from panolog.orchestrator.views.palette import SEAM_GRADES, block_color, seam_grade
from panolog.orchestrator.views.plan_map import BLOCK_STATUSES, BlockStatus, block_statuses, read_points
from panolog.orchestrator.views.preparation import PreparationView, picture_path, view_preparation
from panolog.orchestrator.views.queries import series
from panolog.orchestrator.views.run_view import RunView, view_run
from panolog.orchestrator.views.summary import METRICS, Summary, metric_text, task_label
from panolog.partition.plan import read_plan
from panolog.scene.errors import InputError, PanologError
from panolog.scene.files import write_bytes
from panolog.workers.seams.schema import Seam, by_blocks, parse_seams
from panolog.workers.tasks import COARSE, Stage, TaskId

_Item = TypeVar("_Item")


@dataclass
class _Moved:
    """A camera in RUN/poses.json."""

    name: str
    moved: float  # world units
    turned: float  # degrees
    pixels: float
    at_bound: bool


_HERE = Path(__file__).parent
STATIC = _HERE.parent / "dashboard" / "static"
_STYLES = (STATIC / "shared/base.css", STATIC / "shared/compare.css", _HERE / "report.css")
_SCRIPTS = (  # each after those that it imports
    *(STATIC / "shared/dom.js", STATIC / "shared/charts.js", STATIC / "run/plot.js"),
    STATIC / "run/exposure_curve.js",
    *(STATIC / "run/panorama.js", STATIC / "shared/compare.js", _HERE / "report.js"),
)
_MODULE = re.compile(r"^(import .*;\n|export )", re.MULTILINE)  # what is not needed in one script
_LINES = 24  # blocks that have curves: the first ones
_POINTS = 300  # of a curve
_PICTURES = 12  # held-out panoramas that are shown, from the worst to the best
_WIDTH, _QUALITY = 1024, 82  # pixels and JPEG quality of these
_MOVERS = 6  # panoramas with the largest movers that are shown
_FACES = 3  # between blocks that are shown: the worst
_ROWS = 2_000  # of a table


def write_report(folder: RunFolder, output: Path | None = None, *, running: bool | None = None) -> Path:
    """Writes the report of a run in its present state, atomically; RUN/report.html without `output`.

    Args: running, whether a driver works on the run; by default whether one holds its lock.
    Raises InputError if the folder is no run or its files are damaged; OSError if it cannot be written.
    """
    path = output or folder.report
    running = lock.held(folder.lock) if running is None else running
    write_bytes(path, _render(_content(folder, running=running)).encode())
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


def _render(content: Mapping[str, Any]) -> str:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "duration": duration,
        "size": gib,
        "local": _local,
        "task": task_label,
        "metric": _metric,
        "value": _value,
        "grade": lambda seam: "" if seam is None else seam_grade(seam),
        "decimal": _decimal,
    }
    template = environment.from_string((_HERE / "report.html.j2").read_text(encoding="utf-8"))
    parts = {"plotly": plotly(), "style": joined(_STYLES), "script": scripts(_SCRIPTS)}
    return template.render(content, **{name: Markup(part) for name, part in parts.items()})


def plotly() -> str:
    """plotly.min.js of its Python package."""
    return (files("plotly") / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def scripts(paths: Sequence[Path]) -> str:
    """Scripts as one, each after those that it imports, without the imports. Raises OSError."""
    return _MODULE.sub("", joined(paths))


def joined(paths: Sequence[Path]) -> str:
    """The texts of files one after the other. Raises OSError."""
    return "\n".join(path.read_text(encoding="utf-8") for path in paths)


def _content(folder: RunFolder, *, running: bool) -> dict[str, Any]:
    """The values of the template."""
    info = read_info(folder).model_dump(mode="json")
    history = History.of(read_milestones(folder.database) if folder.database.exists() else ())
    prepared = view_preparation(folder, history.state, running=running)
    view = view_run(history, info, running=running, root=folder.root, preparation=prepared)
    summary, evaluation, seams = view.summary, _evaluation(folder), _seams(folder)
    tasks = {task.name: task for task in summary.tasks}
    statuses = block_statuses(summary)
    present = {status for status, _ in statuses.values()}
    return {
        "name": folder.root.absolute().name,
        "info": info,
        "view": view,
        "state": summary,
        "timeline": _timeline(view),
        "blocks": [
            (block, tasks.get(str(TaskId.block(block.block))), block_color(block.block))
            for block in summary.blocks
        ],
        "prepared": list(_prepared(folder, prepared)),
        "metrics": METRICS,
        "evaluation": evaluation,
        "pictures": list(_pictures(folder, evaluation)),
        "map": _map(folder, statuses, by_blocks(seams)),
        "seams": seams,
        "seam_pictures": list(_seam_pictures(folder, seams)),
        "exposure": _exposure(folder),
        "moves": _moves(folder),
        "fitted": evaluation.get("pose_fit", {}).get("mean"),
        "movers": (movers := _movers(folder)),
        "mover_pictures": list(_mover_pictures(folder, movers)),
        "grades": _grades(by_blocks(seams).values()),
        "map_statuses": [status for status in BLOCK_STATUSES if status in present],
        "curves": _curves(folder, summary),
        "rows": _ROWS,
        "lines": _LINES,
        "changed": [setting for setting in view.config if setting.changed],
        "made": time.time(),
    }


def _timeline(view: RunView) -> list[dict[str, Any]]:
    """The stages with their time in seconds, and where they lie in the time of all of them, in percent."""
    ends = {stage.name: view.now if stage.status == Status.RUNNING else stage.ended for stage in view.stages}
    spans = {
        stage.name: (stage.began, end)
        for stage in view.stages
        if stage.began is not None and (end := ends[stage.name]) is not None
    }
    first = min((began for began, _ in spans.values()), default=0.0)
    whole = max((end for _, end in spans.values()), default=0.0) - first or 1.0
    rows = []
    for stage in view.stages:
        began, end = spans.get(stage.name, (first, None))
        seconds = None if end is None else end - began
        left, width = 100 * (began - first) / whole, 100 * (seconds or 0.0) / whole
        rows.append({"stage": stage, "seconds": seconds, "left": left, "width": width})
    return rows


def _prepared(folder: RunFolder, view: PreparationView | None) -> Iterator[dict[str, str]]:
    """The pictures of a preparation with data URLs."""
    for picture in view.pictures if view else ():
        path = picture_path(folder, picture.name)
        if path is not None and (jpeg := _shrunk(path)) is not None:
            yield {"label": picture.label, "data": data_url("jpeg", jpeg)}


def _evaluation(folder: RunFolder) -> dict[str, Any]:
    """The content of metrics.json; empty before the evaluation."""
    try:
        content = json.loads(folder.metrics.read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise InputError(f"{folder.metrics}: is not JSON: {error}") from error
    return content if isinstance(content, dict) else {}


def _seams(folder: RunFolder) -> tuple[Seam, ...]:
    """What was measured at the faces between blocks, the worst first."""
    return parse_seams(folder.seams.read_bytes()) if folder.seams.exists() else ()


def _seam_pictures(folder: RunFolder, seams: Sequence[Seam]) -> Iterator[dict[str, Any]]:
    """The pictures of the worst faces that have some: their names with data URLs."""
    for face in seams[:_FACES]:
        place = folder.seam(*face.blocks)
        paths = {name: place / f"{name}.jpg" for name in ("truth", "merged", "below", "above")}
        line = place / "face.png"
        if line.is_file() and all(path.is_file() for path in paths.values()):
            pictures = {name: data_url("jpeg", path.read_bytes()) for name, path in paths.items()}
            yield {"face": face, "pictures": pictures, "line": data_url("png", line.read_bytes())}


def _moves(folder: RunFolder) -> list[dict[str, Any]]:
    """How far refined cameras moved, the farthest first; empty where poses stay."""
    if not folder.poses.is_file():
        return []
    try:
        found = TypeAdapter(list[_Moved]).validate_python(json.loads(folder.poses.read_bytes())["panoramas"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder.poses}: is not what a run has written") from error
    return sorted(map(asdict, found), key=lambda each: -each["pixels"])


def _exposure(folder: RunFolder) -> dict[str, Any] | None:
    """The curve of what Stage I has learnt; None where it has not."""
    curve = exposure_curve(folder, Path.read_bytes) if folder.exposure.is_file() else None
    return None if curve is None else curve.model_dump()


def _movers(folder: RunFolder) -> dict[str, float]:
    """The shares of movers in training panoramas, the largest first; empty where none were looked for."""
    if not folder.mover_shares.exists():
        return {}
    try:
        content = json.loads(folder.mover_shares.read_bytes())
        shares = {str(item["name"]): float(item["share"]) for item in content["panoramas"]}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise InputError(f"{folder.mover_shares}: is damaged ({error}); resume the run") from error
    return dict(sorted(shares.items(), key=lambda item: (-item[1], item[0])))


def _mover_pictures(folder: RunFolder, shares: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """The panoramas with the largest movers that have a picture."""
    inside = folder.movers.resolve()
    for name, share in list(shares.items())[:_MOVERS]:
        path = folder.mover_picture(name).resolve()
        if path.is_relative_to(inside) and (jpeg := _shrunk(path)) is not None:
            yield {"name": name, "share": share, "data": data_url("jpeg", jpeg)}


def _grades(seams: Iterable[float]) -> dict[str, str]:
    """What the colours of faces on the map mean, of the grades that there are."""
    present, limits = {seam_grade(seam) for seam in seams}, [least for least, _ in SEAM_GRADES.values()]
    spans = [f"{low:g} to {high:g}" if low else f"below {high:g}" for low, high in pairwise(limits)]
    return {
        name: f"seam {span}"
        for name, span in zip(SEAM_GRADES, [*spans, f"{limits[-1]:g} and more"], strict=True)
        if name in present
    }


def _map(
    folder: RunFolder, statuses: Mapping[int, BlockStatus], seams: Mapping[tuple[int, int], float]
) -> dict[str, Any] | None:
    """The figure of the plan; None before there is one."""
    if not folder.plan.exists():
        return None
    return map_figure(read_plan(folder.plan), read_points(folder.model(COARSE)), statuses, seams)


def _curves(folder: RunFolder, summary: Summary) -> list[dict[str, Any]]:
    """The curves of Stage I and the first districts and blocks, see charts.js; only blocks have a colour."""
    tasks = [TaskId.parse(task.name) for task in summary.tasks]
    blocks = [task for task in tasks if task.stage is Stage.BLOCK][:_LINES]
    districts = [task for task in tasks if task.stage is Stage.DISTRICT][:_LINES]
    curves = []
    for task in (*districts, COARSE, *blocks):
        if task in tasks and (found := series(folder.database, str(task), _POINTS)):
            color = block_color(task.number) if task.stage is Stage.BLOCK else None
            curves.append({"label": task_label(str(task)), "color": color, "series": found})
    return curves


def _pictures(folder: RunFolder, evaluation: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Some held-out panoramas with their renders and metrics."""
    views = evaluation.get("views", {})
    paths = {name: folder.picture(name).resolve() for name in views}
    inside = folder.images.resolve()
    there = [name for name, path in paths.items() if path.is_relative_to(inside) and path.is_file()]
    ranked = sorted(there, key=lambda name: views[name].get("psnr") or 0.0)
    for name in spread(ranked, _PICTURES):
        if (jpeg := _shrunk(paths[name])) is not None:
            yield {"name": name, "metrics": views[name], "data": data_url("jpeg", jpeg)}


def data_url(kind: str, content: bytes) -> str:
    """A picture as a URL. Args: kind, "jpeg" or "png"."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def spread(items: Sequence[_Item], most: int) -> list[_Item]:
    """At most `most` of the items, two or more, evenly spaced, both ends included."""
    if len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


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


def _decimal(value: float | None, places: int) -> str:
    """A number with so many places, or a dash."""
    return "–" if value is None else f"{value:.{places}f}"


def _value(value: Any) -> str:
    """A number or a setting as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
