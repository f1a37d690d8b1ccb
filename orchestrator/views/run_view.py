"""All that a page about a run shows, in one model, for the dashboard, the report and `status --json`."""

import time
from collections.abc import Mapping
from math import prod
from typing import Any

from pydantic import BaseModel

from panolog.orchestrator.run.config import RunConfig, keys
from panolog.orchestrator.run.state import RunState, Status, TaskState
from panolog.orchestrator.views.history import History
from panolog.orchestrator.views.summary import (
    STAGES,
    Summary,
    Text,
    ViewModel,
    share_of,
    summarize,
    tasks_of,
)
from panolog.workers.tasks import COARSE, EVAL, MERGE, PLAN, Stage, TaskId

_SMALL = 0.01  # share of the whole run that each stage without training counts as


class StageView(ViewModel):
    """A stage of a run; `began` and `ended` in epoch seconds, `tasks` and `done` count its tasks."""

    name: str
    label: str
    status: Status
    began: float | None
    ended: float | None
    progress: float  # 0 to 1
    tasks: int
    done: int


class GpuUsageView(ViewModel):
    """What a GPU does; `utilization` 0 to 1."""

    name: Text
    utilization: float | None
    memory_used: int | None
    memory_total: int | None


class UsageView(ViewModel):
    """What a machine does, measured at `time` in epoch seconds: `cpu` 0 to 1, the disk that the run uses."""

    time: float
    cpu: float
    memory_used: int
    memory_total: int
    disk_used: int
    disk_total: int
    gpus: tuple[GpuUsageView, ...]


class NodeView(ViewModel):
    """A machine that tasks have run on, and what runs there now."""

    node: Text
    tasks: tuple[Text, ...]  # running
    gpus: tuple[Text, ...]  # kinds
    device: Text
    memory: int
    rate: float
    usage: UsageView | None


class SettingView(ViewModel):
    """A setting of a run next to its default."""

    key: Text
    value: Any
    default: Any
    changed: bool
    unit_or_doc: str


class LiveView(ViewModel):
    """What changes while a run is running; `now` and `latest` in seconds since the epoch."""

    now: float
    latest: float | None  # the last record
    progress: float  # of the whole run, 0 to 1
    eta: float | None  # of the whole run
    paused: tuple[int, ...]  # blocks
    stages: tuple[StageView, ...]
    nodes: tuple[NodeView, ...]


class RunView(LiveView):
    """All about a run."""

    info: dict[str, Any]  # run.json
    summary: Summary
    began: float | None
    config: tuple[SettingView, ...]


def view_run(
    history: History, info: dict[str, Any], *, running: bool, estimate: Mapping[str, float] | None = None
) -> RunView:
    """The view of a run. Args: info, run.json; estimate, seconds by stage as expected before the start."""
    state, now = history.state, time.time()
    summary = summarize(state, running=running, now=now, estimate=estimate or {})
    return RunView(
        now=now,
        latest=state.latest,
        progress=progress_of(state, info),
        eta=summary.eta,
        paused=summary.paused,
        stages=_stages(history, info),
        nodes=_nodes(history, running=running),
        info=info,
        summary=summary,
        began=state.began,
        config=_settings(info),
    )


def _stages(history: History, info: Mapping[str, Any]) -> tuple[StageView, ...]:
    """The stages of a run in their order, also those to come."""
    refine = _setting(info, "refine", default=True)
    tasks: dict[str, list[TaskState]] = {name: [] for name in STAGES}
    for task in tasks_of(history.state):
        tasks[task.id.stage].append(task)
    names = [name for name in STAGES if refine or name in (Stage.COARSE, Stage.MERGE, Stage.EVAL)]
    return tuple(_stage(name, tasks[name], history) for name in names)


def _stage(name: str, tasks: list[TaskState], history: History) -> StageView:
    statuses = {task.status for task in tasks}
    status = next((s for s in (Status.RUNNING, Status.FAILED) if s in statuses), Status.WAITING)
    planned = history.state.plan is not None
    empty = name == Stage.BLOCK and planned and not tasks  # all keep their Stage I model
    if statuses == {Status.DONE} or empty:
        status = Status.DONE
    span = history.spans.get(Stage(name))
    return StageView(
        name=name,
        label=STAGES[name],
        status=status,
        began=span.began if span else None,
        ended=span.ended if span and status in (Status.DONE, Status.FAILED) else None,
        progress=sum(map(share_of, tasks)) / len(tasks) if tasks else float(empty),
        tasks=len(tasks),
        done=sum(task.status == Status.DONE for task in tasks),
    )


def progress_of(state: RunState, info: Mapping[str, Any]) -> float:
    """How much of the run's work is done, 0 to 1: iterations of Stage I and of blocks, and a little else."""
    if state.outcome == "done":
        return 1.0
    coarse = share_of(state.task(COARSE))
    if not _setting(info, "refine", default=True):
        small = [share_of(state.task(name)) for name in (MERGE, EVAL)]
        return (1 - _SMALL * len(small)) * coarse + _SMALL * sum(small)
    blocks = [share_of(state.task(TaskId.block(b.block))) for b in state.plan or () if b.train]
    count = len(blocks) if state.plan is not None else _block_count(info)
    scores = [share_of(task) for task in state.tasks.values() if task.id.stage is Stage.SCORE]
    small = [share_of(state.task(name)) for name in (PLAN, MERGE, EVAL)]
    small.append(sum(scores) / len(scores) if scores else 0.0)
    trained = (coarse + sum(blocks)) / (1 + count)
    return (1 - _SMALL * len(small)) * trained + _SMALL * sum(small)


def _block_count(info: Mapping[str, Any]) -> int:
    """How many blocks the settings request."""
    sizes = str(_setting(info, "blocks", default="")).split("x")
    return prod(map(int, sizes)) if all(size.isdecimal() for size in sizes) else 1


def _nodes(history: History, *, running: bool) -> tuple[NodeView, ...]:
    """The machines that tasks have run on, by name."""
    views = []
    for node in sorted({start.node for start in history.starts.values()}):
        starts = {
            id: history.starts[id]
            for id in sorted(history.starts, key=str)
            if history.starts[id].node == node
        }
        tasks = [history.state.task(id) for id in starts] if running else []
        active = [task for task in tasks if task.status == Status.RUNNING and task.node == node]
        progress = [task.progress for task in active if task.progress]
        views.append(
            NodeView(
                node=node,
                tasks=tuple(str(task.id) for task in active),
                gpus=tuple(dict.fromkeys(s.place for s in starts.values() if s.place not in ("", "cpu"))),
                device=list(starts.values())[-1].device,
                memory=sum(p.memory or 0 for p in progress),
                rate=sum(p.rate for p in progress),
                usage=None,
            )
        )
    return tuple(views)


def _settings(info: Mapping[str, Any]) -> tuple[SettingView, ...]:
    """All settings of a run, flat, next to their defaults."""
    given = _flat(info.get("config") or {})
    fields = {key: _field(key) for key in keys()}
    return tuple(
        SettingView(
            key=key,
            value=given.get(key),
            default=fields[key][0] if key in fields else None,
            changed=key not in fields or (key in given and given[key] != fields[key][0]),
            unit_or_doc=fields[key][1] if key in fields else "not a setting of this version",
        )
        for key in [*fields, *(key for key in given if key not in fields)]
    )


def _field(key: str) -> tuple[Any, str]:
    """The default of a setting and its description."""
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
