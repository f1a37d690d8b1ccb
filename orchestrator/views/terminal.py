"""A run on the terminal: a table, live while the run lasts, or plain lines if the output is no terminal."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

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
    task_name,
)
from panolog.orchestrator.run.state import OnChange, RunState, Status, TaskState
from panolog.orchestrator.run.units import duration, gib
from panolog.orchestrator.views.summary import (
    METRICS,
    STAGES,
    at_rest,
    eta_of,
    metric_text,
    stage_of,
    status_of,
    tasks_of,
)
from panolog.workers.tasks import Stage, TaskId

WIDE = 120  # columns from which on a table has all its columns
_MOST = 60  # blocks that are shown one by one; of more, those of _NOTABLE, at most so many
_NOTABLE = (Status.RUNNING, Status.FAILED, Status.PAUSED)
_BAR = 24  # columns
_COLOURS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.PAUSED: "yellow"}
_LINES = 15.0  # seconds between two plain lines about one task
_REQUESTS: dict[type[Record], str] = {
    PauseRequested: "will be paused",
    UnpauseRequested: "will continue",
    RetryRequested: "gets all its attempts again",
    TaskYielded: "has stopped with a checkpoint",
}


def table(state: RunState, *, running: bool, wide: bool) -> RenderableType:
    """The whole run for a terminal; `wide` also shows memory and PSNR."""
    head, rows = headline(state, running=running), Table.grid(padding=(0, 2))
    if not running:
        state = at_rest(state)
    stages: dict[Stage, list[TaskState]] = {}
    for task in tasks_of(state):
        stages.setdefault(task.id.stage, []).append(task)
    for stage, tasks in stages.items():
        one_by_one = tasks
        if stage is Stage.SCORE:
            one_by_one = []
        elif len(tasks) > _MOST:
            one_by_one = [task for task in tasks if task.status in _NOTABLE][:_MOST]
        if one_by_one != tasks:
            rows.add_row(*_stage_row(stage, tasks))
        for task in one_by_one:
            rows.add_row(*_task_row(task, wide=wide))
    return Group(head, rows, *_failures(state))


def _failures(state: RunState) -> Iterator[Text]:
    """The last failure of each task that is not done."""
    failed = [task for task in tasks_of(state) if task.reasons and task.status != Status.DONE]
    for task in failed[:_MOST]:
        yield Text(
            f"{task.id}: {task.reasons[-1]}", style="red" if task.status == Status.FAILED else "yellow"
        )


def headline(state: RunState, *, running: bool) -> Text:
    """The state of the run in one line."""
    status = status_of(state, running=running)
    stage = STAGES.get(stage_of(state))
    text = Text(f"{status}" + (f" · {stage}" if stage else ""), style="bold")
    if state.reason:
        text.append(f" · {state.reason}", style="red")
    retries = sum(task.retries for task in state.tasks.values())
    if retries:
        text.append(f" · {retries} retries", style="yellow")
    if held := state.held_blocks():
        text.append(f" · {len(held)} paused: `panolog unpause` continues them", style="yellow")
    moved = sum(task.received + task.sent for task in state.tasks.values())
    if moved:
        text.append(f" · {gib(moved)} moved between machines", style="dim")
    return text


def _task_row(task: TaskState, *, wide: bool) -> Iterator[RenderableType]:
    progress = task.progress
    yield Text(str(task.id), style=_COLOURS.get(task.status, "dim"))
    done = progress.iteration if progress else int(task.status == Status.DONE)
    total = progress.iterations if progress else 1
    yield ProgressBar(total=total, completed=done, width=_BAR)
    yield f"{progress.iteration:,}/{progress.iterations:,}" if progress else task.status
    yield f"{progress.rate:.1f} it/s" if progress and task.status == Status.RUNNING else task.status
    eta = eta_of(task)
    yield f"{duration(eta)} left" if eta is not None else duration(task.seconds) if task.seconds else ""
    yield f"loss {progress.loss:.4f}" if progress and progress.loss is not None else ""
    yield f"{progress.gaussians:,} Gaussians" if progress and progress.gaussians is not None else ""
    if wide:
        yield f"{progress.psnr:.2f} dB" if progress and progress.psnr is not None else ""
        yield gib(progress.memory) if progress and progress.memory is not None else ""


def _stage_row(stage: Stage, tasks: Sequence[TaskState]) -> list[RenderableType]:
    """One row for all known tasks of a stage."""
    statuses = [task.status for task in tasks]
    done, total = statuses.count(Status.DONE), len(statuses)
    status = (
        Status.DONE if done == total else Status.RUNNING if Status.RUNNING in statuses else Status.WAITING
    )
    bar = ProgressBar(total=total, completed=done, width=_BAR)
    name = "shards" if stage is Stage.SCORE else f"{stage}s"
    return [Text(str(stage), style=_COLOURS.get(status, "dim")), bar, f"{done:,}/{total:,} {name}"]


@contextmanager
def progress(console: Console) -> Iterator[OnChange]:
    """Yields a function to call with every change of state; the display lasts as long as the context."""
    if not console.is_terminal:
        yield _Lines(console).show
        return
    latest = RunState()

    def render() -> RenderableType:  # called from a thread of the display
        return table(latest, running=latest.outcome is None, wide=console.width >= WIDE)

    def show(state: RunState, news: Sequence[Stored]) -> None:
        nonlocal latest
        latest = state
        for stored in news:
            if line := _urgent(stored.record):
                console.print(line, highlight=False, markup=False)

    with Live(get_renderable=render, console=console, refresh_per_second=4):
        yield show


class _Lines:
    """A line for each event, and one about each running task every _LINES seconds."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last: dict[TaskId, float] = {}

    def show(self, _: RunState, news: Sequence[Stored]) -> None:
        for stored in news:
            record = stored.record
            line = _urgent(record) or _milestone(record)
            if isinstance(record, Progressed) and self._due(stored, record):
                line = _progress_line(record)
            if line:
                self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _due(self, stored: Stored, record: Progressed) -> bool:
        last = self._last.get(record.task)
        due = last is None or stored.time - last >= _LINES or record.iteration == record.iterations
        if due:
            self._last[record.task] = stored.time
        return due


def _urgent(record: Record) -> str:
    """What a user must read, with either display."""
    match record:
        case Noticed():
            return f"{task_name(record)}: {record.message}"
        case TaskFailed():
            then = record.then or ("given up" if record.final else "trying again")
            return f"{record.task}: {record.reason}; {then}"
        case StopRequested():
            return f"stopping: {record.tasks} tasks save a checkpoint first; repeat to stop at once"
        case PauseRequested() | UnpauseRequested() | RetryRequested() | TaskYielded():
            return f"{record.task}: {_REQUESTS[type(record)]}"
    return ""


def _milestone(record: Record) -> str:
    """What only plain lines need: the table shows it."""
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


def _progress_line(record: Progressed) -> str:
    parts = [f"{record.task}: {record.iteration}/{record.iterations}", f"{record.rate:.1f} it/s"]
    if record.rate > 0:
        parts.append(f"{duration((record.iterations - record.iteration) / record.rate)} left")
    if record.loss is not None:
        parts.append(f"loss {record.loss:.4f}")
    if record.gaussians is not None:
        parts.append(f"{record.gaussians:,} Gaussians")
    return ", ".join(parts)


def metrics_line(metrics: Mapping[str, float | None]) -> str:
    """Means of the metrics in one line."""
    known = {name: value for name, value in metrics.items() if value is not None}
    return ", ".join(
        f"{METRICS.get(name, name)} {metric_text(value, name)}{' dB' * ('psnr' in name)}"
        for name, value in known.items()
    )
