"""The run on the terminal while it goes on: a live table, or plain lines where nobody can see it move."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.live import Live

from panolog.orchestrator.driver.driver import Show
from panolog.orchestrator.run.records import (
    EvaluationSaved,
    Merged,
    ModelSaved,
    Noticed,
    PauseRequested,
    PlanSaved,
    Progressed,
    Record,
    RetryRequested,
    StopRequested,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
    UnpauseRequested,
)
from panolog.orchestrator.run.state import RunState
from panolog.orchestrator.run.units import duration
from panolog.orchestrator.views.table import WIDE, table

_LINES = 15.0  # seconds between two plain lines about one task
_WISHES: dict[type[Record], str] = {
    PauseRequested: "is to be paused",
    UnpauseRequested: "is to go on",
    RetryRequested: "gets all its attempts again",
    TaskYielded: "has stopped with a checkpoint",
}


@contextmanager
def progress(console: Console) -> Iterator[Show]:
    """What to call with every change of state; the display lasts as long as the context."""
    if not console.is_terminal:
        yield _Lines(console).show
        return
    picture = _Picture(console.width >= WIDE)
    with Live(get_renderable=picture.render, console=console, refresh_per_second=4):

        def show(state: RunState, news: Sequence[Stored]) -> None:
            picture.state = state
            for stored in news:
                if line := _news(stored.record):
                    console.print(line, highlight=False, markup=False)

        yield show


class _Picture:
    """What the live display draws; the display asks for it from a thread of its own."""

    def __init__(self, wide: bool) -> None:
        self.state = RunState()
        self._wide = wide

    def render(self) -> RenderableType:
        return table(self.state, running=self.state.outcome is None, wide=self._wide)


class _Lines:
    """One line for each thing that happens, and now and then one about a running task."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last: dict[str, float] = {}

    def show(self, _: RunState, news: Sequence[Stored]) -> None:
        for stored in news:
            record = stored.record
            line = _news(record) or _milestone(record)
            if isinstance(record, Progressed) and self._due(stored, record):
                line = _standing(record)
            if line:
                self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _due(self, stored: Stored, record: Progressed) -> bool:
        last = self._last.get(record.task)
        due = last is None or stored.time - last >= _LINES or record.iteration == record.iterations
        if due:
            self._last[record.task] = stored.time
        return due


def _news(record: Record) -> str:
    """What a person must read, whatever the display."""
    match record:
        case Noticed():
            return f"{record.task}: {record.message}"
        case TaskFailed():
            then = record.then or ("given up" if record.final else "trying again")
            return f"{record.task}: {record.reason}; {then}"
        case StopRequested():
            return f"stopping: {record.tasks} tasks save a checkpoint first; once more to stop at once"
        case PauseRequested() | UnpauseRequested() | RetryRequested() | TaskYielded():
            return f"{record.task}: {_WISHES[type(record)]}"
    return ""


def _milestone(record: Record) -> str:
    """What the table shows by itself."""
    match record:
        case TaskStarted():
            since = f" from iteration {record.iteration}" if record.iteration else ""
            return (
                f"{record.task}: started{since} on {record.node} ({record.device}, {record.threads} threads)"
            )
        case ModelSaved():
            return f"{record.task}: {record.gaussians:,} Gaussians after {duration(record.seconds)}"
        case PlanSaved():
            return f"plan: {len(record.blocks)} blocks"
        case Merged():
            return f"merge: {record.gaussians:,} Gaussians, {record.sky:,} of them sky"
        case EvaluationSaved():
            return "eval: " + metrics_line(record.metrics)
    return ""


def _standing(record: Progressed) -> str:
    parts = [f"{record.task}: {record.iteration}/{record.iterations}", f"{record.rate:.1f} it/s"]
    if record.rate > 0:
        parts.append(f"{duration((record.iterations - record.iteration) / record.rate)} left")
    if record.loss is not None:
        parts.append(f"loss {record.loss:.4f}")
    if record.gaussians is not None:
        parts.append(f"{record.gaussians:,} Gaussians")
    return ", ".join(parts)


def metrics_line(metrics: dict[str, float | None]) -> str:
    """Means of the metrics for people."""
    names = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "ws_psnr": "WS-PSNR", "ws_ssim": "WS-SSIM"}
    units = {"psnr": " dB", "ws_psnr": " dB"}
    digits = {"psnr": 2, "ws_psnr": 2}
    return ", ".join(
        f"{names.get(name, name)} {value:.{digits.get(name, 4)}f}{units.get(name, '')}"
        for name, value in metrics.items()
        if value is not None
    )
