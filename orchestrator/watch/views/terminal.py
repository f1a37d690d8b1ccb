"""A run on the terminal: a table, live while the run lasts, or plain lines if the output is no terminal."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.measure import Measurement
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
from panolog.orchestrator.runs.state import OnChange, RunState, Status
from panolog.orchestrator.runs.units import counted, duration, gib
from panolog.orchestrator.watch.views.preparation import view_preparation
from panolog.orchestrator.watch.views.summary import (
    METRICS,
    STAGES,
    Summary,
    TaskView,
    metric_text,
    summarize,
    task_label,
)
from panolog.workers.tasks import NOTHING_HELD_OUT, Stage, TaskId

WIDE = 120  # columns from which on a table has all its columns
_MOST = 60  # blocks that are shown one by one; of more, those of _NOTABLE, at most so many
_NOTABLE = (Status.RUNNING, Status.FAILED, Status.PAUSED)
_BAR, _SHORT = 24, 8  # columns of a bar in a wide and a narrow terminal
_COLOURS = {Status.RUNNING: "cyan", Status.DONE: "green", Status.FAILED: "red", Status.PAUSED: "yellow"}
_COLUMNS = ("task", "", "iterations", "speed", "time", "loss", "Gaussians")
_NUMBERS = 5  # columns from here on are numbers
_FIRST_LEFT_OUT = ("", "loss", "Gaussians", "time")  # where a terminal is too narrow for all
_LINES = 15.0  # seconds between two plain lines about one task
_REQUESTS: dict[type[Record], str] = {
    PauseRequested: "will be paused",
    UnpauseRequested: "will continue",
    RetryRequested: "gets all its attempts again",
    TaskYielded: "has stopped with a checkpoint",
}


def table(summary: Summary, *, root: Path | str, wide: bool) -> RenderableType:
    """The whole run for a terminal; `wide` also shows memory and PSNR. Args: root, the run in commands."""
    now, rows = time.time(), _Rows(wide)
    stages: dict[Stage, list[TaskView]] = {}
    for task in summary.tasks:
        stages.setdefault(TaskId.parse(task.name).stage, []).append(task)
    for stage, tasks in stages.items():
        one_by_one = tasks
        if stage.in_shards:
            one_by_one = []
        elif len(tasks) > _MOST:
            one_by_one = [task for task in tasks if task.status in _NOTABLE][:_MOST]
        if one_by_one != tasks:
            rows.cells.append(_stage_row(stage, tasks, wide=wide))
        for task in one_by_one:
            rows.cells.append([*_task_row(task, stage, wide=wide)])
    shown = [rows] if stages else []
    waits = [Text(summary.waiting, style="yellow")] if summary.waiting not in ("", summary.label) else []
    waits += _leaving(summary, now)
    waits += _quarantined(summary, now, root)
    money = summary.money.line() if summary.money else ""
    waits += [Text(money, style="dim")] if money else []
    return Group(_headline(summary, root), *waits, *_gaussians(summary), *shown, *_failures(summary))


@dataclass
class _Rows:
    """The table of tasks, without the columns for which a terminal is too narrow."""

    wide: bool
    cells: list[list[RenderableType]] = field(default_factory=list)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        names = [*_COLUMNS, *(("PSNR", "memory") if self.wide else ())]
        unbound = options.update(max_width=WIDE)
        for left_out in _FIRST_LEFT_OUT:
            if Measurement.get(console, unbound, self._of(names)).maximum <= options.max_width:
                break
            names[names.index(left_out)] = None
        yield self._of(names)

    def _of(self, names: Sequence[str | None]) -> Table:
        """The columns that have a name."""
        kept = [at for at, name in enumerate(names) if name is not None]
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim", show_edge=False)
        for at in kept:
            table.add_column(names[at] or "", no_wrap=True, justify="left" if at < _NUMBERS else "right")
        for row in self.cells:
            table.add_row(*(row[at] for at in kept if at < len(row)))
        return table


def _gaussians(summary: Summary) -> Iterator[Text]:
    """How many Gaussians are in training, and how many are kept."""
    parts = []
    if summary.training_gaussians:
        parts.append(f"{summary.training_gaussians:,} Gaussians in training")
    if summary.kept_gaussians and summary.stage != Stage.COARSE:
        parts.append(f"{summary.kept_gaussians:,}{' Gaussians' * (not parts)} kept")
    if parts:
        yield Text(", ".join(parts), style="dim")


def _failures(summary: Summary) -> Iterator[Text]:
    """The last failure of each task that is not done, unless the headline says it."""
    failed = [task for task in summary.tasks if task.reasons and task.status != Status.DONE]
    failed = [task for task in failed if task.reasons[-1] not in (summary.reason or "")]
    for task in failed[:_MOST]:
        yield Text(
            f"{task_label(task.name)}: {task.reasons[-1]}",
            style="red" if task.status == Status.FAILED else "yellow",
        )


def _leaving(summary: Summary, now: float) -> Iterator[Text]:
    """The machines that leave. Args: now, epoch seconds."""
    for node in summary.leaving[:_MOST]:
        when = "" if node.until is None else f" in {duration(max(0.0, node.until - now))}"
        yield Text(f"{node.host} ({node.node[:8]}): leaves{when}: {node.reason}", style="yellow")


def _quarantined(summary: Summary, now: float, root: Path | str) -> Iterator[Text]:
    """The machines in quarantine, and how to release the first. Args: as of `table`, and `_leaving`."""
    for node in summary.quarantined[:_MOST]:
        name = f"{node.host} ({node.node[:8]})"
        left = duration(max(0.0, node.until - now))
        yield Text(f"{name}: in quarantine for another {left}: {node.reason}", style="yellow")
    if summary.quarantined and summary.status == "running":
        yield _to_copy(f"`{command_line('release', root, summary.quarantined[0].host)}` uses it again")


def _to_copy(line: str) -> Text:
    """A line with a command, which is not broken."""
    return Text(line, style="yellow", no_wrap=True, overflow="ignore")


def page(summary: Summary, *, root: Path | str, wide: bool) -> RenderableType:
    """`table`, and of a run that does not proceed why, and what resumes it."""
    lines = [Text(summary.reason, style="red")] if summary.reason else []
    if summary.resume:
        more = " --max-cost none --deadline none" if summary.status == "limited" else ""
        lines.append(_to_copy(f"`{summary.resume}{more}` resumes it"))
    return Group(table(summary, root=root, wide=wide), *lines)


def _headline(summary: Summary, root: Path | str) -> Text:
    """The state of the run in one line."""
    stage = "" if summary.label == "preparing" else STAGES.get(summary.stage)
    text = Text(summary.label + (f" · {stage}" if stage else ""), style="bold")
    if summary.step:
        text.append(f": {summary.step}")
    text.append(f" · {math.floor(summary.progress * 100)}%")  # 100% is only what is done
    if summary.seconds is not None:
        text.append(f" · {duration(summary.seconds)} elapsed")
    if summary.eta is not None:
        text.append(f" · about {duration(summary.eta)} left")
    retries = sum(task.retries for task in summary.tasks)
    if retries:
        text.append(f" · {retries} {'retry' if retries == 1 else 'retries'}", style="yellow")
    if held := summary.paused:
        unpause = command_line("unpause", root, held[0])
        text.append(f" · {len(held)} paused: `{unpause}` resumes block {held[0]}", style="yellow")
    if moves := sum(task.moves for task in summary.tasks):
        text.append(f" · {moves} moved from machines that left", style="dim")
    moved = summary.moved.received + summary.moved.sent
    if moved:
        text.append(f" · {gib(moved)} moved between machines", style="dim")
    return text


def _task_row(task: TaskView, stage: Stage, *, wide: bool) -> Iterator[RenderableType]:
    yield Text(task_label(task.name), style=_COLOURS.get(task.status, "dim"))
    begun = task.iteration is not None and task.iterations is not None
    done = task.iteration if task.iteration is not None else int(task.status == Status.DONE)
    yield _bar(done, task.iterations if task.iterations is not None else 1, task.status, wide=wide)
    yield f"{task.iteration:,}/{task.iterations:,}{' views' * (not stage.trains)}" if begun else ""
    yield f"{task.rate:.1f} it/s" if begun and task.status == Status.RUNNING else task.status
    taken = duration(task.seconds) if task.seconds else ""
    yield taken if task.eta is None else f"{duration(task.eta)} left"
    yield "" if task.loss is None else f"{task.loss:.4f}"
    yield "" if task.gaussians is None else f"{task.gaussians:,}"
    if wide:
        yield "" if task.psnr is None else f"{task.psnr:.2f} dB"
        yield "" if task.memory is None else gib(task.memory)


def _bar(done: int, total: int, status: Status, *, wide: bool) -> ProgressBar:
    width, colour = _BAR if wide else _SHORT, _COLOURS.get(status, "cyan")
    return ProgressBar(total, done, width, complete_style=colour, finished_style=colour)


def _stage_row(stage: Stage, tasks: Sequence[TaskView], *, wide: bool) -> list[RenderableType]:
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
        running = latest.outcome is None
        made = view_preparation(RunFolder(root), latest, running=running)
        summary = summarize(latest, running=running, prepared=made.over if made else None)
        return table(summary, root=root, wide=console.width >= WIDE)

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
            return f"{task}: {counted(len(record.blocks), 'block')}"
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
