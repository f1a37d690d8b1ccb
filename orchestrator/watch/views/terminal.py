"""A run on the terminal: a table, live while the run lasts, or plain lines if the output is no terminal."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from panolog.orchestrator.runs.folder import RunFolder, command_line
from panolog.orchestrator.runs.machines.history import leave_text
from panolog.orchestrator.runs.money.records import BudgetNear, BudgetReached
from panolog.orchestrator.runs.records import (
    Delivered,
    EvaluationSaved,
    Merged,
    ModelSaved,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeReleased,
    NodeStaying,
    Noticed,
    PauseRequested,
    PlanSaved,
    Preparing,
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
from panolog.orchestrator.runs.state import OnChange, RunState, Status, TaskState, at_rest
from panolog.orchestrator.runs.units import duration, gib
from panolog.orchestrator.watch.views.preparation import prepared_share, view_preparation
from panolog.orchestrator.watch.views.summary import (
    METRICS,
    STAGES,
    Summary,
    metric_text,
    reason_of,
    summarize,
    task_label,
)
from panolog.orchestrator.watch.views.timing import eta_of, seconds_of, tasks_of
from panolog.workers.tasks import NOTHING_HELD_OUT, Stage, TaskId

WIDE = 120  # columns from which on a table has all its columns
_MOST = 60  # blocks that are shown one by one; of more, those of _NOTABLE, at most so many
_NOTABLE = (Status.RUNNING, Status.FAILED, Status.PAUSED)
_BAR, _SHORT = 24, 8  # columns of a bar in a wide and a narrow terminal
_COLOURS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.PAUSED: "yellow"}
_LINES = 15.0  # seconds between two plain lines about one task
_REQUESTS: dict[type[Record], str] = {
    PauseRequested: "will be paused",
    UnpauseRequested: "will continue",
    RetryRequested: "gets all its attempts again",
    TaskYielded: "has stopped with a checkpoint",
}


def table(state: RunState, *, root: Path, running: bool, wide: bool, name: str = "") -> RenderableType:
    """The whole run for a terminal; `wide` also shows memory and PSNR.

    Args: root, the run folder; running, whether a driver works on it; name, of the run in
    commands, if that is not its folder.
    """
    now = time.time()
    preparation = view_preparation(RunFolder(root), state, running=running)
    prepared = None if preparation is None else prepared_share(preparation)
    summary = summarize(state, running=running, now=now, root=root, prepared=prepared)
    head = headline(state, summary, name or root)
    rows = _rows(wide=wide)
    if not running:
        state = at_rest(state)
        now = state.ended or now
    stages: dict[Stage, list[TaskState]] = {}
    for task in tasks_of(state):
        stages.setdefault(task.id.stage, []).append(task)
    for stage, tasks in stages.items():
        one_by_one = tasks
        if stage.in_shards:
            one_by_one = []
        elif len(tasks) > _MOST:
            one_by_one = [task for task in tasks if task.status in _NOTABLE][:_MOST]
        if one_by_one != tasks:
            rows.add_row(*_stage_row(stage, tasks, wide=wide))
        for task in one_by_one:
            rows.add_row(*_task_row(task, now, wide=wide))
    shown = [rows] if stages else []
    waits = [Text(summary.waiting, style="yellow")] if summary.waiting not in ("", summary.label) else []
    waits += _leaving(summary, now)
    waits += _quarantined(summary, now, name or root)
    money = summary.money.line() if summary.money else ""
    waits += [Text(money, style="dim")] if money else []
    return Group(head, *waits, *_gaussians(summary), *shown, *_failures(state))


def _rows(*, wide: bool) -> Table:
    """The table without its rows."""
    rows = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim", show_edge=False)
    for name in ("task", "", "iterations", "speed", "time"):
        rows.add_column(name, no_wrap=True)
    for name in ("loss", "Gaussians", *(("PSNR", "memory") if wide else ())):
        rows.add_column(name, no_wrap=True, justify="right")
    return rows


def _gaussians(summary: Summary) -> Iterator[Text]:
    """How many Gaussians are in training, and how many are kept."""
    parts = []
    if summary.training_gaussians:
        parts.append(f"{summary.training_gaussians:,} Gaussians in training")
    if summary.kept_gaussians and summary.stage != Stage.COARSE:
        parts.append(f"{summary.kept_gaussians:,}{' Gaussians' * (not parts)} kept")
    if parts:
        yield Text(", ".join(parts), style="dim")


def _failures(state: RunState) -> Iterator[Text]:
    """The last failure of each task that is not done, unless the headline says it."""
    failed = [task for task in tasks_of(state) if task.reasons and task.status != Status.DONE]
    failed = [task for task in failed if task.reasons[-1] not in state.reason]
    for task in failed[:_MOST]:
        yield Text(
            f"{task_label(str(task.id))}: {task.reasons[-1]}",
            style="red" if task.status == Status.FAILED else "yellow",
        )


def _leaving(summary: Summary, now: float) -> Iterator[Text]:
    """The machines that leave. Args: now, epoch seconds."""
    for node in summary.leaving[:_MOST]:
        when = "" if node.until is None else f" in {duration(max(0.0, node.until - now))}"
        yield Text(f"{node.host} ({node.node[:8]}): leaves{when}: {node.reason}", style="yellow")


def _quarantined(summary: Summary, now: float, root: Path | str) -> Iterator[Text]:
    """The machines in quarantine, and how to release the first. Args: now, epoch seconds; root, as `page`."""
    for node in summary.quarantined[:_MOST]:
        name = f"{node.host} ({node.node[:8]})"
        left = duration(max(0.0, node.until - now))
        yield Text(f"{name}: in quarantine for another {left}: {node.reason}", style="yellow")
    if summary.quarantined and summary.status == "running":
        yield _to_copy(f"`{command_line('release', root, summary.quarantined[0].host)}` uses it again")


def _to_copy(line: str) -> Text:
    """A line with a command, which is not broken."""
    return Text(line, style="yellow", no_wrap=True, overflow="ignore")


def page(state: RunState, *, root: Path, running: bool, wide: bool, name: str = "") -> RenderableType:
    """`table`, and of a run that does not proceed why, and what resumes it."""
    lines = []
    if reason := reason_of(state, running=running):
        lines.append(Text(reason, style="red"))
    if not running and state.outcome != "done":
        more = ("--max-cost", "none", "--deadline", "none") if state.outcome == "limited" else ()
        lines.append(_to_copy(f"`{command_line('resume', name or root, *more)}` resumes it"))
    return Group(table(state, root=root, running=running, wide=wide, name=name), *lines)


def headline(state: RunState, summary: Summary, root: Path | str) -> Text:
    """The state of the run in one line. Args: root, the run folder in commands."""
    stage = "" if summary.label == "preparing" else STAGES.get(summary.stage)
    text = Text(summary.label + (f" · {stage}" if stage else ""), style="bold")
    if summary.step:
        text.append(f": {summary.step}")
    text.append(f" · {summary.progress:.0%}")
    if summary.seconds is not None:
        text.append(f" · {duration(summary.seconds)} elapsed")
    if summary.eta is not None:
        text.append(f" · about {duration(summary.eta)} left")
    retries = sum(task.retries for task in state.tasks.values())
    if retries:
        text.append(f" · {retries} retries", style="yellow")
    if held := summary.paused:
        unpause = command_line("unpause", root, held[0])
        text.append(f" · {len(held)} paused: `{unpause}` resumes block {held[0]}", style="yellow")
    if moves := sum(task.moves for task in state.tasks.values()):
        text.append(f" · {moves} moved from machines that left", style="dim")
    moved = summary.moved.received + summary.moved.sent
    if moved:
        text.append(f" · {gib(moved)} moved between machines", style="dim")
    return text


def _task_row(task: TaskState, now: float, *, wide: bool) -> Iterator[RenderableType]:
    progress = task.progress
    yield Text(task_label(str(task.id)), style=_COLOURS.get(task.status, "dim"))
    done = progress.iteration if progress else int(task.status == Status.DONE)
    total = progress.iterations if progress else 1
    yield _bar(done, total, task.status, wide=wide)
    views = "" if task.id.stage.trains else " views"
    yield f"{progress.iteration:,}/{progress.iterations:,}{views}" if progress else ""
    yield f"{progress.rate:.1f} it/s" if progress and task.status == Status.RUNNING else task.status
    eta, seconds = eta_of(task, now), seconds_of(task, now)
    yield f"{duration(eta)} left" if eta is not None else duration(seconds) if seconds else ""
    yield f"{progress.loss:.4f}" if progress and progress.loss is not None else ""
    yield f"{progress.gaussians:,}" if progress and progress.gaussians is not None else ""
    if wide:
        yield f"{progress.psnr:.2f} dB" if progress and progress.psnr is not None else ""
        yield gib(progress.memory) if progress and progress.memory is not None else ""


def _bar(done: int, total: int, status: Status, *, wide: bool) -> ProgressBar:
    width, colour = _BAR if wide else _SHORT, _COLOURS.get(status, "cyan")
    return ProgressBar(total, done, width, complete_style=colour, finished_style=colour)


def _stage_row(stage: Stage, tasks: Sequence[TaskState], *, wide: bool) -> list[RenderableType]:
    """One row for all known tasks of a stage."""
    statuses = [task.status for task in tasks]
    done, total = statuses.count(Status.DONE), len(statuses)
    status = (
        Status.DONE if done == total else Status.RUNNING if Status.RUNNING in statuses else Status.WAITING
    )
    bar = _bar(done, total, status, wide=wide)
    name = "shards" if stage.in_shards else f"{stage}s"
    return [Text(STAGES[stage], style=_COLOURS.get(status, "dim")), bar, f"{done:,}/{total:,} {name}"]


@contextmanager
def progress(console: Console, root: Path) -> Iterator[OnChange]:
    """Yields a function to call with every change of state; the display lasts as long as the context.

    Args: root, the run folder.
    """
    if not console.is_terminal:
        yield _Lines(console).show
        return
    latest = RunState()

    def render() -> RenderableType:  # called from a thread of the display
        running, wide = latest.outcome is None, console.width >= WIDE
        return table(latest, root=root, running=running, wide=wide)

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
        self._waiting = ""
        self._step = time.monotonic()  # of the last line about the preparation

    def show(self, state: RunState, news: Sequence[Stored]) -> None:
        if state.preparing and not news and time.monotonic() - self._step >= _LINES:
            self._step = time.monotonic()
            self._console.print(state.step, highlight=False, markup=False, soft_wrap=True)
        if state.waiting != self._waiting:  # also if a full disk takes no record of it
            self._waiting = state.waiting
            line = state.waiting or "the run continues"
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)
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
    task = task_label(task_name(record))
    match record:
        case Noticed():
            return f"{task}: {record.message}"
        case TaskFailed() if record.final and record.task.stage is not Stage.BLOCK:
            return ""  # the run fails for this reason, with which the command ends
        case TaskFailed():
            then = record.then or ("given up" if record.final else "trying again")
            return f"{task}: {record.reason}; {then}"
        case BudgetNear() | BudgetReached():
            return record.what if isinstance(record, BudgetNear) else record.reason
        case StopRequested() if record.tasks:
            tasks = "a task saves" if record.tasks == 1 else f"{record.tasks} tasks save"
            return f"stopping: {tasks} a checkpoint first; repeat to stop at once"
        case NodeQuarantined():
            return f"{record.host} ({record.node[:8]}): in quarantine: {record.reason}"
        case NodeReleased():
            return f"{record.host} ({record.node[:8]}): out of quarantine: {record.reason}"
        case NodeLeaving():
            return leave_text(record)
        case NodeStaying():
            return f"{record.host} ({record.node[:8]}): stays after all, and is used again"
        case NodeLeft():
            return f"{record.host} ({record.node[:8]}): has left"
        case TaskYielded() if record.leaves:
            return f"{task}: has stopped with a checkpoint, and moves: {record.leaves} leaves"
        case PauseRequested() | UnpauseRequested() | RetryRequested() | TaskYielded():
            return f"{task}: {_REQUESTS[type(record)]}"
    return ""


def _milestone(record: Record) -> str:
    """What only plain lines need: the table shows it."""
    task = task_label(task_name(record))
    match record:
        case Preparing():
            return record.step
        case TaskStarted():
            since = f" from iteration {record.iteration}" if record.iteration else ""
            where = f"{record.node} ({record.device}, {record.threads} threads)"
            return f"{task}: started{since} on {where}"
        case ModelSaved():
            return f"{task}: {record.gaussians:,} Gaussians after {duration(record.seconds)}"
        case PlanSaved():
            return f"{task}: {len(record.blocks)} blocks"
        case Merged():
            return f"{task}: {record.gaussians:,} Gaussians, {record.sky:,} of them sky"
        case EvaluationSaved():
            return f"{task}: {metrics_line(record.metrics) or NOTHING_HELD_OUT}"
        case Delivered() if record.path:
            return f"{task}: {record.path}, {record.size / 1e6:,.1f} MB of files for viewers"
    return ""


def _progress_line(record: Progressed) -> str:
    parts = [
        f"{task_label(task_name(record))}: {record.iteration}/{record.iterations}"
        + " views" * (not record.task.stage.trains),
        f"{record.rate:.1f} it/s",
    ]
    if record.rate > 0:
        parts.append(f"{duration((record.iterations - record.iteration) / record.rate)} left")
    if record.loss is not None:
        parts.append(f"loss {record.loss:.4f}")
    if record.gaussians is not None:
        parts.append(f"{record.gaussians:,} Gaussians")
    return ", ".join(parts)


def metrics_line(metrics: Mapping[str, float | None]) -> str:
    """Means of the metrics in one line."""
    known = {name: value for name, value in metrics.items() if value is not None and name in METRICS}
    return ", ".join(
        f"{METRICS[name]} {metric_text(value, name)}{' dB' * ('psnr' in name)}"
        for name, value in known.items()
    )
