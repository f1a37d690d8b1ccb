"""A run's state as other programs and people want it: one JSON object, or a table."""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from panolog.orchestrator.state import (
    DONE,
    FAILED,
    RUNNING,
    WAITING,
    RunState,
    TaskState,
    block_task,
    score_task,
)
from panolog.orchestrator.units import gib

WIDE = 120  # columns from which on a table shows all it has
STAGES = {
    "coarse": "Stage I",
    "score": "scoring",
    "plan": "partition",
    "block": "Stage II",
    "merge": "merge",
    "eval": "evaluation",
}
_COLOURS = {RUNNING: "cyan", DONE: "green", FAILED: "red"}


def status_of(state: RunState, *, running: bool) -> str:
    """ "running", "done", "failed", "interrupted", or "stopped" if the driver was killed."""
    if running:
        return "running"
    return state.outcome or "stopped"


def stage_of(state: RunState) -> str:
    """The key in STAGES of what the run is at; "done" at its end."""
    if state.outcome == "done":
        return "done"
    active = [name.partition("/")[0] for name, task in state.tasks.items() if task.status == RUNNING]
    if active:
        return max(active, key=list(STAGES).index)
    over = [name.partition("/")[0] for name, task in state.tasks.items() if task.status == DONE]
    return max(over, key=list(STAGES).index, default="coarse")


def as_json(state: RunState, *, running: bool, now: float | None = None) -> dict[str, Any]:
    """What `panolog status --json` prints. Times in seconds, memory and sizes in bytes, rates per second."""
    head = {"status": status_of(state, running=running), "stage": stage_of(state)}
    if not running:
        state = _at_rest(state)
    end = state.ended or (time.time() if now is None else now)
    merged = state.merged
    return head | {
        "reason": state.reason or None,
        "seconds": None if state.began is None else end - state.began,
        "eta": _longest_eta(state),
        "tasks": [_task_json(task) for task in tasks_of(state)],
        "blocks": [
            {"block": b.block, "cameras": b.cameras, "gaussians": b.gaussians, "train": b.train}
            for b in state.plan or ()
        ],
        "model": merged and {"path": merged.path, "gaussians": merged.gaussians, "bytes": merged.size},
        "metrics": state.metrics,
        "moved": {
            "received": sum(task.received for task in state.tasks.values()),
            "sent": sum(task.sent for task in state.tasks.values()),
        },
        "notices": [{"task": notice.task, "message": notice.message} for notice in state.notices],
    }


def _at_rest(state: RunState) -> RunState:
    """The same without a driver: what was running waits, and time has ended with the last record."""
    tasks = {
        name: replace(task, status=WAITING) if task.status == RUNNING else task
        for name, task in state.tasks.items()
    }
    return replace(state, tasks=tasks, ended=state.ended or state.latest)


def tasks_of(state: RunState) -> list[TaskState]:
    """All tasks that are known, in the order of the stages; blocks of the plan also before they start."""
    names = set(state.tasks) | {block_task(b.block) for b in state.plan or () if b.train}
    order = list(STAGES)
    return [state.task(name) for name in sorted(names, key=lambda n: (order.index(n.partition("/")[0]), n))]


def eta_of(task: TaskState) -> float | None:
    """Seconds that a running task still needs at its present rate."""
    progress = task.progress
    if task.status != RUNNING or progress is None or progress.rate <= 0:
        return None
    return (progress.iterations - progress.iteration) / progress.rate


def table(state: RunState, *, running: bool, wide: bool) -> RenderableType:
    """The whole run for a terminal; `wide` also shows memory and PSNR."""
    head, rows = headline(state, running=running), Table.grid(padding=(0, 2))
    if not running:
        state = _at_rest(state)
    for task in tasks_of(state):
        if task.name == score_task(0):
            rows.add_row(*_scoring_row(state))
        elif not task.name.startswith("score/"):
            rows.add_row(*_cells(task, wide=wide))
    return Group(head, rows)


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
    moved = sum(task.received + task.sent for task in state.tasks.values())
    if moved:
        text.append(f" · {gib(moved)} moved between machines", style="dim")
    return text


def duration(seconds: float) -> str:
    """Seconds for people: 4:07 or 2:04:07."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _longest_eta(state: RunState) -> float | None:
    """Seconds until the running tasks are over; later stages are not in it."""
    return max((eta for task in state.tasks.values() if (eta := eta_of(task)) is not None), default=None)


def _task_json(task: TaskState) -> dict[str, Any]:
    progress = task.progress
    return {
        "name": task.name,
        "status": task.status,
        "iteration": progress and progress.iteration,
        "iterations": progress and progress.iterations,
        "rate": progress and progress.rate,
        "eta": eta_of(task),
        "loss": progress and progress.loss,
        "psnr": progress and progress.psnr,
        "gaussians": progress and progress.gaussians,
        "memory": progress and progress.memory,
        "host_peak": progress and progress.host_peak,
        "seconds": task.seconds,
        "checkpoint": task.checkpoint,
        "node": task.node or None,
        "received": task.received,
        "sent": task.sent,
        "retries": task.retries,
        "reasons": list(task.reasons),
    }


def _cells(task: TaskState, *, wide: bool) -> Iterator[RenderableType]:
    progress = task.progress
    yield Text(task.name, style=_COLOURS.get(task.status, "dim"))
    done = progress.iteration if progress else int(task.status == DONE)
    total = progress.iterations if progress else 1
    yield ProgressBar(total=total, completed=done, width=24)
    yield f"{progress.iteration:,}/{progress.iterations:,}" if progress else task.status
    yield f"{progress.rate:.1f} it/s" if progress and task.status == RUNNING else task.status
    eta = eta_of(task)
    yield f"{duration(eta)} left" if eta is not None else duration(task.seconds) if task.seconds else ""
    yield f"loss {progress.loss:.4f}" if progress and progress.loss is not None else ""
    yield f"{progress.gaussians:,} Gaussians" if progress and progress.gaussians is not None else ""
    if wide:
        yield f"{progress.psnr:.2f} dB" if progress and progress.psnr is not None else ""
        yield gib(progress.memory) if progress and progress.memory is not None else ""


def _scoring_row(state: RunState) -> list[RenderableType]:
    """All scoring shards that have begun in one row."""
    statuses = [task.status for name, task in state.tasks.items() if name.startswith("score/")]
    done, total = statuses.count(DONE), len(statuses)
    status = DONE if done == total else RUNNING if RUNNING in statuses else WAITING
    bar = ProgressBar(total=total, completed=done, width=24)
    return [Text("score", style=_COLOURS.get(status, "dim")), bar, f"{done}/{total} shards"]
