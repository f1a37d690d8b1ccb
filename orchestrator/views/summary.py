"""How a run stands: the words for it, and all of it as the one JSON object that other programs want."""

import time
from dataclasses import replace
from typing import Any

from panolog.orchestrator.run.state import DONE, RUNNING, RunState, TaskState, block_task

STAGES = {
    "coarse": "Stage I",
    "score": "scoring",
    "plan": "partition",
    "block": "Stage II",
    "merge": "merge",
    "eval": "evaluation",
}


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
        state = at_rest(state)
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
        "paused": list(state.held_blocks()),
        "model": merged and {"path": merged.path, "gaussians": merged.gaussians, "bytes": merged.size},
        "metrics": state.metrics,
        "moved": {
            "received": sum(task.received for task in state.tasks.values()),
            "sent": sum(task.sent for task in state.tasks.values()),
        },
        "notices": [{"task": notice.task, "message": notice.message} for notice in state.notices],
    }


def at_rest(state: RunState) -> RunState:
    """The same without a driver: what was running waits, and time has ended with the last record."""
    tasks = {
        name: replace(task, status=task.at_rest) if task.status == RUNNING else task
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
