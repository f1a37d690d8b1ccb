"""All that a page about a run shows, in one model, for the dashboard, the report and `status --json`."""

import time
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic.fields import FieldInfo

from panolog.orchestrator.runs.config import known_settings
from panolog.orchestrator.runs.folder import flat, part_of
from panolog.orchestrator.runs.machines.gpus import GpuUsage
from panolog.orchestrator.runs.state import RunState, Status, TaskState, at_rest
from panolog.orchestrator.watch.views.history import History, Span
from panolog.orchestrator.watch.views.preparation import PreparationView
from panolog.orchestrator.watch.views.summary import (
    STAGES,
    LeavingView,
    QuarantineView,
    Summary,
    Text,
    ViewModel,
    summarize,
)
from panolog.orchestrator.watch.views.timing import share_of, tasks_of
from panolog.workers.tasks import Stage
from panolog.workers.training.recipes import RECIPES

_CHOSEN = ("device", "width", "partition.cuts")  # settings that a run chooses where they are not given
STOPPED: Literal["stopped"] = "stopped"  # of a stage whose driver has ended before it


class StageView(ViewModel):
    """A stage of a run; `began` and `ended` in epoch seconds, `seconds` those in which a driver was at work.

    `tasks` and `done` count its tasks.
    """

    name: str
    label: str
    status: Status | Literal["stopped"]
    began: float | None
    ended: float | None
    seconds: float | None
    progress: float  # 0 to 1
    tasks: int
    done: int


class UsageView(ViewModel):
    """What a machine does, measured at `time` in epoch seconds: `cpu` 0 to 1, the disk that the run uses."""

    time: float
    cpu: float
    memory_used: int
    memory_total: int
    disk_used: int
    disk_total: int
    gpus: tuple[GpuUsage, ...]


class NodeView(ViewModel):
    """A machine that tasks have run on, and what runs there now."""

    node: Text
    tasks: tuple[Text, ...]  # running
    gpus: tuple[Text, ...]  # kinds
    device: Text
    memory: int
    rate: float
    usage: UsageView | None
    quarantine: QuarantineView | None = None
    leaving: LeavingView | None = None


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
    preparation: PreparationView | None = None  # of a run that makes its scene
    store: Text = ""  # how far it has been copied to its object store; "" if it has none


class RunView(LiveView):
    """All about a run."""

    info: dict[str, Any]  # run.json
    summary: Summary
    began: float | None
    config: tuple[SettingView, ...]


def scene_name(run: RunView) -> str:
    """The name of a run's scene, or of what the run makes its scene of."""
    made = run.preparation
    source = made.source if made else str(part_of(run.info, "scene").get("path", ""))
    return Path(source).name + (f" and {len(made.others)} more" if made and made.others else "")


def view_run(
    history: History,
    info: dict[str, Any],
    *,
    running: bool,
    root: Path | None = None,
    usages: Mapping[str, Mapping[str, Any]] | None = None,
    waiting: str = "",
    preparation: PreparationView | None = None,
    store: str = "",
) -> RunView:
    """The view of a run.

    Args: info, run.json; running, root, as `summarize`; usages, `queries.usages`; waiting, of `presence`;
    preparation, `view_preparation`; store, `MirrorState.brief`.
    """
    state, now = history.state, time.time()
    state = replace(state, waiting=state.waiting or waiting)
    prepared = preparation.over if preparation else None
    summary = summarize(state, running=running, now=now, root=root, prepared=prepared)
    stages = _stages(history, info, running=running, now=now)
    return RunView(
        now=now,
        latest=_later(state.latest, preparation.latest if preparation else None),
        progress=summary.progress,
        eta=summary.eta,
        paused=summary.paused,
        stages=tuple(_with_share(stage, preparation) for stage in stages),
        nodes=_nodes(history, usages or {}, summary, running=running),
        preparation=preparation,
        store=store,
        info=info,
        summary=summary,
        began=state.began,
        config=_settings(info),
    )


def _later(one: float | None, other: float | None) -> float | None:
    return max(one, other) if one is not None and other is not None else one


def _stages(history: History, info: Mapping[str, Any], *, running: bool, now: float) -> Iterator[StageView]:
    """The stages of a run in their order, also those to come. Args: now, epoch seconds."""
    state = history.state if running else at_rest(history.state)
    planned = {task.stage for tasks in state.between for task in tasks}
    config = part_of(info, "config")
    shown = {
        Stage.PREPARE: Stage.PREPARE in history.spans,
        Stage.CALIBRATE: not history.spans.keys().isdisjoint((Stage.PREPARE, Stage.CALIBRATE)),
        Stage.DISTRICT: config.get("districts", 1) != 1,
        **dict.fromkeys((Stage.SCORE, Stage.PLAN, Stage.BLOCK), config.get("refine", True)),
        Stage.UNION: False,  # it takes next to no time
        Stage.ROUND: Stage.ROUND in planned,
        Stage.REPAIR: Stage.REPAIR in planned,
        Stage.MEASURE: bool(state.measures),
        Stage.DELIVER: config.get("deliver", False),  # older versions did not
    }
    every = tasks_of(state)
    for name in map(Stage, STAGES):
        span = history.spans.get(name)
        if shown.get(name, True):
            tasks = [task for task in every if task.id.stage is name]
            cut = history.cut(name)
            at_end = state if cut is None else replace(state, ended=cut)
            yield _stage(name, tasks, at_end, span, running=running and cut is None, now=now)


def _with_share(stage: StageView, preparation: PreparationView | None) -> StageView:
    """The stage; of the preparation how much of its time is over."""
    if stage.name != Stage.PREPARE or preparation is None or stage.status == Status.DONE:
        return stage
    return stage.model_copy(update={"progress": preparation.progress})


def _stage(
    name: Stage, tasks: Sequence[TaskState], state: RunState, span: Span | None, *, running: bool, now: float
) -> StageView:
    statuses = {task.status for task in tasks}
    status = _stage_status(name, statuses, state, begun=span is not None, running=running)
    over = status == Status.DONE or (status == Status.FAILED and statuses <= {Status.DONE, Status.FAILED})
    ended = seconds = None
    if span is not None and (over or status in (Status.FAILED, STOPPED)):
        ended = span.ended if over else state.ended
    if span is not None and (ended is not None or status == Status.RUNNING):
        seconds = state.worked(span.began, now if ended is None else ended)
    return StageView(
        name=name,
        label=STAGES[name],
        status=status,
        began=span.began if span else None,
        ended=ended,
        seconds=seconds,
        progress=sum(map(share_of, tasks)) / len(tasks) if tasks else float(status == Status.DONE),
        tasks=len(tasks),
        done=sum(task.status == Status.DONE for task in tasks),
    )


def _stage_status(
    name: Stage, statuses: Set[Status], state: RunState, *, begun: bool, running: bool
) -> Status | Literal["stopped"]:
    """How a stage stands. Args: statuses, those of its tasks; begun, whether it has ever been; running, as
    `view_run`.
    """
    if name is (Stage.PREPARE if state.preparing else Stage.CALIBRATE) and not state.prepared:
        return Status.RUNNING if running else STOPPED
    if name is Stage.PREPARE:
        return Status.DONE
    if name is Stage.CALIBRATE and state.preparing and not state.prepared:
        return Status.WAITING
    kept = name is Stage.BLOCK and state.plan is not None and not statuses  # all keep their Stage I model
    if statuses == {Status.DONE} or kept or name is Stage.CALIBRATE:
        return Status.DONE
    if Status.RUNNING in statuses:
        return Status.RUNNING
    if Status.FAILED in statuses and (not running or statuses <= {Status.DONE, Status.FAILED}):
        return Status.FAILED
    return STOPPED if statuses and begun and not running else Status.WAITING


def _nodes(
    history: History,
    usages: Mapping[str, Mapping[str, Any]],
    summary: Summary,
    *,
    running: bool,
) -> tuple[NodeView, ...]:
    """The machines that tasks have run on, by name, and those in quarantine or that leave."""
    views = []
    quarantined = {node.host: node for node in summary.quarantined}
    leaving = {node.host: node for node in summary.leaving}
    known = {start.node for start in history.starts.values()}
    for node in sorted(known | quarantined.keys() | leaving.keys()):
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
                device=list(starts.values())[-1].device if starts else "",
                memory=sum(p.memory or 0 for p in progress),
                rate=sum(p.rate for p in progress),
                usage=UsageView.model_validate(usages[node]) if running and node in usages else None,
                quarantine=quarantined.get(node),
                leaving=leaving.get(node),
            )
        )
    return tuple(views)


def _settings(info: Mapping[str, Any]) -> tuple[SettingView, ...]:
    """All settings of a run, flat, next to their defaults, those of its recipe; first what was changed.

    What the run has chosen itself, such as its device, is no change.
    """
    values, given = dict(flat(info.get("config") or {})), info.get("given")
    preset = RECIPES.get(values.get("recipe", "paper"), {})
    fields = {
        key: (preset.get(key, _default(field)), field.description or "") for key, field in known_settings()
    }

    def changed(key: str) -> bool:
        if key not in fields:
            return True
        differs = key in values and values[key] != fields[key][0]
        return differs and (key in given if isinstance(given, list) else key not in _CHOSEN)

    views = [
        SettingView(
            key=key,
            value=values.get(key),
            default=fields[key][0] if key in fields else None,
            changed=changed(key),
            unit_or_doc=fields[key][1] if key in fields else "not a setting of this version",
        )
        for key in [*fields, *(key for key in values if key not in fields)]
    ]
    return tuple(sorted(views, key=lambda view: not view.changed))


def _default(field: FieldInfo) -> Any:
    """The own default of a setting, as run.json would have it."""
    default = field.get_default(call_default_factory=True, validated_data={})
    return list(default) if isinstance(default, tuple) else default
