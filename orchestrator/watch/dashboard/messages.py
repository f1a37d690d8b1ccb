"""The JSON of the API as models. static/shared/messages.d.ts is made from them: `make types`."""

from datetime import datetime
from typing import Any

from pydantic import ConfigDict

from panolog.orchestrator.runs.folder import part_of
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.views.comparison.measured import whole
from panolog.orchestrator.watch.views.comparison.schema import Comparison, CurvesOfRuns
from panolog.orchestrator.watch.views.exposures import ExposureCurve
from panolog.orchestrator.watch.views.pages.findings import Findings
from panolog.orchestrator.watch.views.plan_page import BlockCameras, CameraView
from panolog.orchestrator.watch.views.run_view import LiveView, RunView, scene_name
from panolog.orchestrator.watch.views.summary import STAGES, SummaryHead, TaskView, Text, ViewModel


class Actions(ViewModel):
    """What can be done with a run now, why nothing can, and the last line of a driver that failed."""

    allowed: bool
    why: Text | None
    available: tuple[str, ...]
    failed: Text | None


class Results(ViewModel):
    """Which results of a run can be downloaded.

    `in_3d` says whether a 3D view has something to show, as from the first picture of Stage I on. `outline`
    changes with what is known of the place before there is a plan, `exposure` with the exposures, if there
    are any, `findings` with what was measured.
    """

    model: bool
    report: bool
    view: bool = False  # a page in 3D of the model as one file
    sog: bool = False  # the model for viewers, next to a report
    in_3d: bool = False
    map: bool = False  # whether cameras and points can be shown from above, also before there is a plan
    outline: str | None = None
    exposure: str | None = None
    findings: str = ""


class RunPage(RunView):
    """GET /api/runs/{id} and the stream's "run"."""

    id: str
    name: Text
    path: Text
    actions: Actions
    result: Results


class RunChanges(LiveView):
    """The stream's "changes": what has changed since the last message; of the tasks those that have."""

    id: str
    actions: Actions
    result: Results
    summary: SummaryHead
    tasks: tuple[TaskView, ...]


class RunRow(ViewModel):
    """A run in the list: `status` also "unread" or "unreadable"; `created` and `latest` in epoch seconds.

    `cover` is the number of its picture, see GET …/cover/{event}; the panoramas are `width` pixels wide.
    """

    id: str
    name: Text
    status: str = "unread"
    label: str = ""
    scene: Text | None = None
    stage: str | None = None
    stage_label: str = ""
    progress: float = 0.0
    eta: float | None = None
    psnr: float | None = None
    gaussians: int | None = None
    size: int | None = None
    created: float | None = None
    latest: float | None = None
    seconds: float | None = None
    width: int | None = None
    iterations: int | None = None
    blocks: int | None = None
    cover: int | None = None
    error: Text | None = None

    @staticmethod
    def of_page(page: RunPage, cover: int | None = None) -> "RunRow":
        """The row of a run that could be read. Args: cover, the event of its picture."""
        summary, model, settings = page.summary, page.summary.model, part_of(page.info, "config")
        return RunRow(
            id=page.id,
            name=page.name,
            status=summary.status,
            label=summary.label,
            scene=scene_name(page),
            stage=summary.stage,
            stage_label=STAGES.get(summary.stage, ""),
            progress=page.progress,
            eta=page.eta,
            psnr=(summary.metrics or {}).get("psnr"),
            gaussians=summary.kept_gaussians,
            size=model.bytes if model else None,
            created=_epoch(page.info.get("created")) or page.began,
            latest=page.latest,
            seconds=summary.seconds,
            width=whole(settings.get("width")),
            iterations=whole(settings.get("iterations")),
            blocks=len(summary.blocks) or None,
            cover=cover,
        )

    @staticmethod
    def unread(entry: RunEntry) -> "RunRow":
        """The row of a run of which only its place is known."""
        return RunRow(id=entry.id, name=entry.name)


def _epoch(moment: Any) -> float | None:
    """Seconds since the epoch of a time in run.json."""
    try:
        return datetime.fromisoformat(str(moment).replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError):
        return None


class QueueRow(ViewModel):
    """An entry of the queue. `run` is the id of its run, if that is below the dashboard's folder.

    `label` is its state, or "interrupted" where no process of a running one is alive; `share`, what it has of
    the machine, or is to get as stated, "" if neither is known; `time`, in epoch seconds, that of its end,
    else of its start, else of its addition.
    """

    id: int
    name: Text
    run: str | None
    state: str
    label: str
    reason: Text
    share: str
    time: float


class QueueList(ViewModel):
    """The queue: those that run, those that wait in order, and the latest that have ended.

    `hidden` entries are not shown; `error` says why the queue cannot be read.
    """

    folder: Text
    runner: bool = False
    hidden: int = 0
    entries: tuple[QueueRow, ...] = ()
    error: Text | None = None


class RunList(ViewModel):
    """GET /api/runs and the stream's "runs": newest first. `queue` is null where there is none."""

    folder: Text
    runs: tuple[RunRow, ...]
    queue: QueueList | None = None


class RunEvent(ViewModel):
    """A record of a run, with the fields of its type."""

    model_config = ConfigDict(extra="allow")

    id: int
    time: float
    type: str
    task: Text


class EventList(ViewModel):
    """GET …/events and the stream's "events": newest first. To continue: `before` = `next`."""

    events: tuple[RunEvent, ...]
    more: bool = False
    next: int | None = None


class SavedPreview(ViewModel):
    """A render of a panorama, above the photograph."""

    event: int
    task: Text
    iteration: int
    view: Text
    time: float
    held_out: bool = False


class PreviewList(ViewModel):
    """GET …/previews."""

    previews: tuple[SavedPreview, ...]


class HeldOutView(ViewModel):
    """A held-out panorama with its metrics."""

    number: int
    name: Text
    metrics: dict[str, float | None] | None


class HeldOutViews(ViewModel):
    """GET …/views."""

    views: tuple[HeldOutView, ...]


class Series(ViewModel):
    """A curve: iterations, epoch seconds, values. GET …/series has one for each name."""

    iteration: tuple[float, ...]
    time: tuple[float, ...]
    value: tuple[float | None, ...]


MESSAGES = (
    RunList,
    RunPage,
    RunChanges,
    EventList,
    PreviewList,
    HeldOutViews,
    Series,
    ExposureCurve,
    Findings,
    CameraView,
    BlockCameras,
    Comparison,
    CurvesOfRuns,
)
