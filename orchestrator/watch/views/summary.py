"""The state of a run in one model: `panolog status --json`, and a part of every view of a run."""

import time
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, SkipValidation

from panolog.orchestrator.runs.folder import command_line
from panolog.orchestrator.runs.machines.history import Leave, NodeState, why_leaving
from panolog.orchestrator.runs.money.account import MoneyView, view_money
from panolog.orchestrator.runs.records import BlockPlan, Leaving, task_name
from panolog.orchestrator.runs.state import RunState, Status, TaskState, at_rest
from panolog.orchestrator.watch.views.timing import (
    elapsed,
    eta_of,
    progress_of,
    run_eta,
    seconds_of,
    share_of,
    tasks_of,
)
from panolog.workers.tasks import COARSE, Progress, Stage, TaskId

STAGES: dict[str, str] = {
    Stage.PREPARE: "preparation",
    Stage.CALIBRATE: "preflight",
    Stage.DISTRICT: "Stage I of districts",
    Stage.COARSE: "Stage I",
    Stage.SCORE: "scoring",
    Stage.PLAN: "partition",
    Stage.BLOCK: "Stage II",
    Stage.UNION: "union of blocks",
    Stage.ROUND: "second round",
    Stage.REPAIR: "seam repair",
    Stage.MERGE: "merge",
    Stage.MEASURE: "measurement",
    Stage.EVAL: "evaluation",
    Stage.DELIVER: "delivery",
}
_TASKS = STAGES | {
    Stage.CALIBRATE: "calibration",
    Stage.DISTRICT: "district",
    Stage.BLOCK: "block",
    Stage.UNION: "union",
    Stage.ROUND: "second round of block",
    Stage.REPAIR: "repair of seam",
}
METRICS = {"psnr": "PSNR", "ssim": "SSIM", "lpips": "LPIPS", "ws_psnr": "WS-PSNR", "ws_ssim": "WS-SSIM"}
LABELS = {"interrupted": "stopped", "stopped": "driver lost", "limited": "ended early"}  # for people
Text = Annotated[str, SkipValidation]  # of users and file systems: also what UTF-8 cannot represent


class ViewModel(BaseModel):
    """Times in seconds, memory and sizes in bytes, rates per second; None where a value is not known."""

    model_config = ConfigDict(frozen=True)


class TaskView(ViewModel):
    """A task: its progress, where it runs, and what went wrong; `seconds` of all its attempts."""

    name: Text
    status: Status
    share: float  # done, 0 to 1
    iteration: int | None
    iterations: int | None
    rate: float | None
    eta: float | None
    loss: float | None
    psnr: float | None
    gaussians: int | None
    memory: int | None
    host_peak: int | None
    seconds: float | None
    checkpoint: int | None
    node: Text | None
    received: int
    sent: int
    retries: int
    moves: int = 0  # attempts that have ended with a checkpoint because their machine left
    reasons: tuple[Text, ...]


_REPORTED = TaskView.model_fields.keys() & Progress.__dataclass_fields__


class ModelView(ViewModel):
    """The merged model."""

    path: Text
    gaussians: int
    bytes: int


class MovedView(ViewModel):
    """Bytes between machines."""

    received: int
    sent: int


class NoticeView(ViewModel):
    """What a user should read."""

    task: Text
    message: Text


class QuarantineView(ViewModel):
    """A machine on which nothing is placed; `until` in epoch seconds."""

    node: Text  # its id
    host: Text
    state: Literal["quarantined"] = "quarantined"
    reason: Text
    until: float


class LeavingView(ViewModel):
    """A machine that has announced that it leaves; `until` in epoch seconds, None if it is not known when."""

    node: Text  # its id
    host: Text
    kind: Leaving
    reason: Text
    until: float | None


class SummaryHead(ViewModel):
    """The state of a run but for its tasks and blocks.

    `status` is for programs, `label` says the same to people. `seconds` are those in which a driver was at
    work, `eta` is that of the whole run.
    """

    status: str
    label: str
    stage: str
    step: Text | None  # what the driver does before its first task
    reason: Text | None  # why the run has failed, or that its driver is lost
    waiting: Text  # why it waits for its disk or a machine; "" if it does not
    resume: Text | None  # the command that resumes it
    progress: float  # elapsed ÷ (elapsed + left), 0 to 1
    seconds: float | None
    eta: float | None
    paused: tuple[int, ...]
    training_gaussians: int | None  # sum over tasks in training, copies included
    kept_gaussians: int | None  # of the merged model, before it of what the merge would keep now
    model: ModelView | None
    metrics: dict[str, float | None] | None
    moved: MovedView
    notices: tuple[NoticeView, ...]
    quarantined: tuple[QuarantineView, ...]  # machines
    leaving: tuple[LeavingView, ...] = ()  # machines
    money: MoneyView | None = None  # what it has cost; None of runs of older versions


class Summary(SummaryHead):
    """The state of a run: what `panolog status --json` prints."""

    tasks: tuple[TaskView, ...]
    blocks: tuple[BlockPlan, ...]


def summarize(
    state: RunState,
    *,
    running: bool,
    now: float | None = None,
    root: Path | str | None = None,
    prepared: float | None = None,
) -> Summary:
    """The summary of a state.

    Args: running, whether a driver works on it; now, epoch seconds; root, the run folder in commands;
    prepared, as `progress_of`.
    """
    stage = stage_of(state)
    status = "running" if running else state.outcome or "stopped"  # the latter of a driver that was killed
    reason = reason_of(state, running=running)
    end = state.ended or (None if running else state.latest) or (time.time() if now is None else now)
    progress = progress_of(state, end, prepared)
    if not running:
        state = at_rest(state)
    preparing = "preparing" if running and stage == Stage.PREPARE else ""
    merged, idle = state.merged, not running and status != "done"
    return Summary(
        status=status,
        label=_waits(state.waiting) or preparing or LABELS.get(status, status),
        stage=stage,
        step=state.step or None,
        reason=reason,
        waiting=state.waiting,
        resume=command_line("resume", root) if idle and root is not None else None,
        progress=progress,
        seconds=elapsed(state, end),
        eta=run_eta(state, end, prepared) if running else None,
        paused=state.held_blocks(),
        training_gaussians=_training(state),
        kept_gaussians=_kept(state),
        model=ModelView(path=merged.path, gaussians=merged.gaussians, bytes=merged.size) if merged else None,
        metrics=state.metrics,
        moved=MovedView(
            received=sum(task.received for task in state.tasks.values()),
            sent=sum(task.sent for task in state.tasks.values()),
        ),
        notices=tuple(NoticeView(task=task_name(notice), message=notice.message) for notice in state.notices),
        quarantined=tuple(
            QuarantineView(node=node.id, host=node.host, reason=node.reason, until=node.until or 0.0)
            for node in state.quarantined()
            if running or (node.until or 0.0) > end
        ),
        leaving=tuple(_leaving(node) for node in state.leaving() if running),
        money=view_money(state, end, running=running),
        tasks=tuple(_task_view(task, end) for task in tasks_of(state)),
        blocks=state.plan or (),
    )


def _waits(why: str) -> str:
    """Why a run waits in a few words: "waiting: block 1 is paused"; "waiting" if that takes a sentence."""
    return why.partition("; ")[0] if why.startswith("waiting: ") else "waiting" * bool(why)


def _leaving(node: NodeState) -> LeavingView:
    leave = node.leave or Leave(Leaving.DRAIN)
    return LeavingView(
        node=node.id, host=node.host, kind=leave.kind, reason=why_leaving(leave.kind), until=leave.until
    )


def _training(state: RunState) -> int | None:
    """Gaussians in training now: blocks train copies of those near their borders."""
    running = [task.progress for task in state.tasks.values() if task.status == Status.RUNNING]
    counts = [progress.gaussians for progress in running if progress and progress.gaussians is not None]
    return sum(counts) or None


def _kept(state: RunState) -> int | None:
    """Gaussians of the merged model; before it of Stage I, in cells of done blocks those of the blocks."""
    if state.merged is not None:
        return state.merged.gaussians
    coarse = state.task(COARSE)
    if coarse.gaussians is None:
        return coarse.progress.gaussians if coarse.progress else None
    blocks = [(block, state.task(TaskId.block(block.block))) for block in state.plan or ()]
    added = [task.gaussians - block.gaussians for block, task in blocks if task.gaussians is not None]
    return coarse.gaussians + sum(added)


def _task_view(task: TaskState, now: float) -> TaskView:
    return TaskView(
        name=str(task.id),
        status=task.status,
        share=share_of(task),
        eta=eta_of(task, now),
        seconds=seconds_of(task, now),
        checkpoint=task.checkpoint,
        node=task.node or None,
        received=task.received,
        sent=task.sent,
        retries=task.retries,
        moves=task.moves,
        reasons=task.reasons,
        **{name: getattr(task.progress, name, None) for name in _REPORTED},
    )


def reason_of(state: RunState, *, running: bool) -> str | None:
    """Why a run does not proceed: the reason of its failure, or what is known of a lost driver."""
    if running or state.outcome is not None:
        return state.reason or None
    driver = state.driver
    who = f"the driver, process {driver.pid} on {driver.host}," if driver else "the driver"
    return f"{who} was killed or has crashed"


def stage_of(state: RunState) -> str:
    """The key in STAGES of the stage that the run is in; "done" at its end."""
    if state.outcome in ("done", "limited"):
        return "done"
    known = state.tasks.values()
    running = [task.id for task in known if task.status == Status.RUNNING]
    begun = [task.id for task in known if task.status != Status.WAITING or task.since is not None]
    if running or begun:
        return str(max(running or begun).stage)
    return str(Stage.COARSE if state.prepared else Stage.PREPARE if state.preparing else Stage.CALIBRATE)


def task_label(task: str) -> str:
    """A task as people read it, from its id: "Stage I", "block 3", "scoring 0", "merge"; "run" for ""."""
    kind, _, number = task.partition("/")
    name = _TASKS.get(kind, kind) or "run"
    return f"{name} {int(number)}" if number.isdecimal() else name


def metric_text(value: float, name: str) -> str:
    """A metric as text: PSNR in dB with two digits, others with four."""
    return f"{value:.{2 if 'psnr' in name else 4}f}"
