"""A run's state as a table for the terminal."""

from collections.abc import Iterator, Sequence

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from panolog.orchestrator.run.state import DONE, FAILED, PAUSED, RUNNING, WAITING, RunState, TaskState
from panolog.orchestrator.run.units import duration, gib
from panolog.orchestrator.views.summary import STAGES, at_rest, eta_of, stage_of, status_of, tasks_of

WIDE = 120  # columns from which on a table shows all it has
_MOST = 60  # blocks that are shown one by one; of more, those of _NOTABLE, as far as that
_NOTABLE = (RUNNING, FAILED, PAUSED)
_BAR = 24  # columns
_COLOURS = {RUNNING: "cyan", DONE: "green", FAILED: "red", PAUSED: "yellow"}


def table(state: RunState, *, running: bool, wide: bool) -> RenderableType:
    """The whole run for a terminal; `wide` also shows memory and PSNR."""
    head, rows = headline(state, running=running), Table.grid(padding=(0, 2))
    if not running:
        state = at_rest(state)
    stages: dict[str, list[TaskState]] = {}
    for task in tasks_of(state):
        stages.setdefault(task.name.partition("/")[0], []).append(task)
    for stage, tasks in stages.items():
        one_by_one = tasks
        if stage == "score":
            one_by_one = []
        elif len(tasks) > _MOST:
            one_by_one = [task for task in tasks if task.status in _NOTABLE][:_MOST]
        if one_by_one != tasks:
            rows.add_row(*_together(stage, tasks))
        for task in one_by_one:
            rows.add_row(*_cells(task, wide=wide))
    return Group(head, rows, *_failures(state))


def _failures(state: RunState) -> Iterator[Text]:
    """Why tasks that are not done have failed so far."""
    failed = [task for task in tasks_of(state) if task.reasons and task.status != DONE]
    for task in failed[:_MOST]:
        yield Text(f"{task.name}: {task.reasons[-1]}", style="red" if task.status == FAILED else "yellow")


def headline(state: RunState, *, running: bool) -> Text:
    """One line: how the run stands."""
    status = status_of(state, running=running)
    stage = STAGES.get(stage_of(state))
    text = Text(f"{status}" + (f" · {stage}" if stage else ""), style="bold")
    if state.reason:
        text.append(f" · {state.reason}", style="red")
    retries = sum(task.retries for task in state.tasks.values())
    if retries:
        text.append(f" · {retries} retries", style="yellow")
    if held := state.held_blocks():
        text.append(f" · {len(held)} paused: `panolog unpause` lets them go on", style="yellow")
    moved = sum(task.received + task.sent for task in state.tasks.values())
    if moved:
        text.append(f" · {gib(moved)} moved between machines", style="dim")
    return text


def _cells(task: TaskState, *, wide: bool) -> Iterator[RenderableType]:
    progress = task.progress
    yield Text(task.name, style=_COLOURS.get(task.status, "dim"))
    done = progress.iteration if progress else int(task.status == DONE)
    total = progress.iterations if progress else 1
    yield ProgressBar(total=total, completed=done, width=_BAR)
    yield f"{progress.iteration:,}/{progress.iterations:,}" if progress else task.status
    yield f"{progress.rate:.1f} it/s" if progress and task.status == RUNNING else task.status
    eta = eta_of(task)
    yield f"{duration(eta)} left" if eta is not None else duration(task.seconds) if task.seconds else ""
    yield f"loss {progress.loss:.4f}" if progress and progress.loss is not None else ""
    yield f"{progress.gaussians:,} Gaussians" if progress and progress.gaussians is not None else ""
    if wide:
        yield f"{progress.psnr:.2f} dB" if progress and progress.psnr is not None else ""
        yield gib(progress.memory) if progress and progress.memory is not None else ""


def _together(stage: str, tasks: Sequence[TaskState]) -> list[RenderableType]:
    """All tasks of a stage that are known in one row."""
    statuses = [task.status for task in tasks]
    done, total = statuses.count(DONE), len(statuses)
    status = DONE if done == total else RUNNING if RUNNING in statuses else WAITING
    bar = ProgressBar(total=total, completed=done, width=_BAR)
    name = "shards" if stage == "score" else f"{stage}s"
    return [Text(stage, style=_COLOURS.get(status, "dim")), bar, f"{done:,}/{total:,} {name}"]
