"""A run in the words of the pages: one row of the list, and all of its own page."""

from collections.abc import Mapping
from datetime import datetime
from math import prod
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from panolog.orchestrator.dashboard.places import Place
from panolog.orchestrator.dashboard.snapshot import Page
from panolog.orchestrator.run.config import RunConfig, keys
from panolog.orchestrator.run.state import DONE, FAILED, RUNNING, WAITING, RunState, TaskState, block_task
from panolog.orchestrator.views import summary
from panolog.orchestrator.views.timeline import History

_SMALL = 0.01  # share of the whole run that each stage without training is taken for


def stages_of(history: History, info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The stages of a run in their order, also those to come."""
    state, refine = history.state, _setting(info, "refine", default=True)
    names = [name for name in summary.STAGES if refine or name in ("coarse", "merge", "eval")]
    tasks: dict[str, list[TaskState]] = {name: [] for name in summary.STAGES}
    for task in summary.tasks_of(state):
        tasks[task.name.partition("/")[0]].append(task)
    return [_stage(name, tasks[name], history) for name in names]


def _stage(name: str, tasks: list[TaskState], history: History) -> dict[str, Any]:
    statuses = {task.status for task in tasks}
    status = next((s for s in (RUNNING, FAILED) if s in statuses), WAITING)
    empty = name == "block" and history.state.plan is not None and not tasks  # all keep their Stage I model
    if statuses == {DONE} or empty:
        status = DONE
    span = history.spans.get(name)
    return {
        "name": name,
        "label": summary.STAGES[name],
        "status": status,
        "began": span and span.began,
        "ended": span.ended if span and status in (DONE, FAILED) else None,
        "progress": sum(map(_done, tasks)) / len(tasks) if tasks else float(empty),
        "tasks": len(tasks),
        "done": sum(task.status == DONE for task in tasks),
    }


def _done(task: TaskState) -> float:
    """How much of a task is done, 0 to 1."""
    if task.status == DONE:
        return 1.0
    progress = task.progress
    return min(1.0, progress.iteration / progress.iterations) if progress and progress.iterations else 0.0


def progress_of(state: RunState, info: Mapping[str, Any]) -> float:
    """How much of the run's work is done, 0 to 1: iterations of Stage I and of blocks, and a little else."""
    if state.outcome == "done":
        return 1.0
    coarse = _done(state.task("coarse"))
    if not _setting(info, "refine", default=True):
        small = [_done(state.task(name)) for name in ("merge", "eval")]
        return (1 - _SMALL * len(small)) * coarse + _SMALL * sum(small)
    blocks = [_done(state.task(block_task(b.block))) for b in state.plan or () if b.train]
    count = len(blocks) if state.plan is not None else _planned(info)
    scores = [_done(task) for name, task in state.tasks.items() if name.startswith("score/")]
    small = [_done(state.task(name)) for name in ("plan", "merge", "eval")]
    small.append(sum(scores) / len(scores) if scores else 0.0)
    trained = (coarse + sum(blocks)) / (1 + count)
    return (1 - _SMALL * len(small)) * trained + _SMALL * sum(small)


def _planned(info: Mapping[str, Any]) -> int:
    """Blocks that the settings ask for."""
    sizes = str(_setting(info, "blocks", default="")).split("x")
    return prod(map(int, sizes)) if all(size.isdecimal() for size in sizes) else 1


def eta_of(state: RunState, estimate: Mapping[str, float]) -> float | None:
    """Seconds until the run is done: what runs and waits at its present rate, later stages as was estimated.

    Args: estimate, seconds by stage that were expected before the start. None while nothing has a rate.
    """
    now = summary.stage_of(state)
    etas = [eta for task in state.tasks.values() if (eta := summary.eta_of(task)) is not None]
    if not etas or now == "done":
        return None
    eta = max(etas)
    if now == "block":
        running = [task for task in state.tasks.values() if task.status == RUNNING and task.progress]
        rate = sum(task.progress.rate for task in running if task.progress)
        length = max(task.progress.iterations for task in running if task.progress)
        names = [block_task(b.block) for b in state.plan or () if b.train]
        left = sum(1 - _done(task) for task in map(state.task, names) if task.status not in (DONE, FAILED))
        eta = max(eta, left * length / rate)
    order = list(summary.STAGES)
    return eta + sum(estimate.get(name, 0.0) for name in order[order.index(now) + 1 :])


def nodes_of(history: History, *, running: bool) -> list[dict[str, Any]]:
    """The machines that tasks have run on, and what each does now."""
    nodes: dict[str, dict[str, Any]] = {}
    for name, start in sorted(history.starts.items()):
        node = nodes.setdefault(
            start.node,
            {"node": start.node, "tasks": [], "gpus": [], "device": "", "memory": 0, "rate": 0.0},
        )
        node["device"] = start.device
        if start.place and start.place != "cpu" and start.place not in node["gpus"]:
            node["gpus"].append(start.place)
        task = history.state.task(name)
        if running and task.status == RUNNING and task.node == start.node:
            node["tasks"].append(name)
            if task.progress:
                node["memory"] += task.progress.memory or 0
                node["rate"] += task.progress.rate
    return [nodes[node] for node in sorted(nodes)]


def config_of(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All settings of a run, flat, beside what they are without anybody's asking."""
    given = _flat(info.get("config") or {})
    fields = {key: _field(key) for key in keys()}
    return [
        {
            "key": key,
            "value": given.get(key),
            "default": fields[key][0] if key in fields else None,
            "changed": key not in fields or (key in given and given[key] != fields[key][0]),
            "unit_or_doc": fields[key][1] if key in fields else "not a setting of this version",
        }
        for key in [*fields, *(key for key in given if key not in fields)]
    ]


def _field(key: str) -> tuple[Any, str]:
    """The default of a setting and what it is."""
    model: type[BaseModel] = RunConfig
    *groups, name = key.split(".")
    for group in groups:
        kind = model.model_fields[group].annotation
        assert isinstance(kind, type)
        model = kind
    info = model.model_fields[name]
    return info.get_default(call_default_factory=True, validated_data={}), info.description or ""


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """A nested mapping by dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items() if isinstance(tree, dict) else ():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _setting(info: Mapping[str, Any], key: str, *, default: Any) -> Any:
    config = info.get("config")
    return config.get(key, default) if isinstance(config, dict) else default


def unread(place: Place) -> Page:
    """The row of a run of which no more is known than that it is there."""
    names = ("scene", "stage", "eta", "psnr", "gaussians", "size", "created", "latest", "seconds", "error")
    empty = dict.fromkeys(names)
    return {
        "id": place.id,
        "name": place.name,
        "status": "unread",
        "stage_label": "",
        "progress": 0.0,
    } | empty


def row_of(page: Page) -> Page:
    """A run's row in the list, from its page."""
    body, info = page["summary"], page["info"]
    model, metrics = body["model"] or {}, body["metrics"] or {}
    scene = info.get("scene")
    counts = [task["gaussians"] for task in body["tasks"] if task["gaussians"]]
    return {
        "id": page["id"],
        "name": page["name"],
        "scene": Path(str(scene.get("path", ""))).name if isinstance(scene, dict) else "",
        "status": body["status"],
        "stage": body["stage"],
        "stage_label": summary.STAGES.get(body["stage"], ""),
        "progress": page["progress"],
        "eta": page["eta"],
        "psnr": metrics.get("psnr"),
        "gaussians": model.get("gaussians") or (max(counts) if counts else None),
        "size": model.get("bytes"),
        "created": _seconds(info.get("created")) or page["began"],
        "latest": page["latest"],
        "seconds": body["seconds"],
        "error": None,
    }


def _seconds(moment: Any) -> float | None:
    """Seconds since the epoch of a time as run.json has it."""
    try:
        return datetime.fromisoformat(str(moment).replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError):
        return None
