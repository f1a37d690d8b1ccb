"""How far a run is and how long it still takes."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

from panolog.orchestrator.runs.state import RunState, Status, TaskState
from panolog.workers.tasks import COARSE, EVAL, MERGE, PLAN, Stage, TaskId

_SMALL = 0.01  # share of the whole run that each stage without training counts as
_PREPARED = (
    0.1  # the same of making the scene, where the run does that: how long it takes is not known before
)


def tasks_of(state: RunState) -> list[TaskState]:
    """All tasks that are known, in the order of the stages; those of the plan also before they start."""
    tasks = set(state.tasks) | {TaskId.block(b.block) for b in state.plan or () if b.train}
    tasks.update(state.measures, *state.between)
    return [state.task(task) for task in sorted(tasks)]


def share_of(task: TaskState) -> float:
    """How much of a task is done, 0 to 1."""
    if task.status == Status.DONE:
        return 1.0
    progress = task.progress
    return min(1.0, progress.iteration / progress.iterations) if progress and progress.iterations else 0.0


def eta_of(task: TaskState) -> float | None:
    """Seconds that a running task still needs at its present rate."""
    progress = task.progress
    if task.status != Status.RUNNING or progress is None or progress.rate <= 0:
        return None
    return (progress.iterations - progress.iteration) / progress.rate


def seconds_of(task: TaskState, now: float) -> float | None:
    """Seconds of all attempts at a task up to a time; None before the first. Args: now, epoch seconds."""
    if task.status == Status.RUNNING and task.since is not None:
        return task.spent + now - task.since
    return task.spent + (task.seconds or 0.0) or None


def run_eta(state: RunState, now: float) -> float | None:
    """Seconds until a run is done: its tasks at their present rates, what is to come as estimated before.

    Args: now, epoch seconds. None if the run has ended, or if a stage that trains has neither a rate nor an
    estimate.
    """
    if state.outcome is not None:
        return None
    stages = [stage for stage in Stage if state.estimate is None or stage in state.estimate]
    left = [_stage_left(state, stage, now) for stage in stages]
    known = [seconds for seconds in left if seconds is not None]
    return sum(known) if len(known) == len(left) else None


def _stage_left(state: RunState, stage: Stage, now: float) -> float | None:
    """Seconds that a stage still needs; None if that is not known."""
    tasks = [task for task in tasks_of(state) if task.id.stage is stage]
    left = [task for task in tasks if task.status not in (Status.DONE, Status.FAILED)]
    over = not left and (tasks or (stage is Stage.BLOCK and state.plan is not None))
    if stage is Stage.DISTRICT and tasks:
        over = state.status(COARSE) == Status.DONE
    if over:
        return 0.0
    expected = (state.estimate or {}).get(stage)
    etas = [eta for task in left if (eta := eta_of(task)) is not None]
    if not etas and not (stage is Stage.DISTRICT and tasks and expected is not None):
        return _expected_left(stage, expected, tasks, left, now)
    if stage.refines:
        return max(*etas, _blocks_left(left))
    if (stage is Stage.DISTRICT or stage.in_shards) and expected is not None:  # tasks that wait are not known
        began = min((task.since for task in tasks if task.since is not None), default=now)
        return max([*etas, 0.0, expected - (now - began)])
    return max(etas)


def _expected_left(
    stage: Stage, expected: float | None, tasks: Sequence[TaskState], left: Sequence[TaskState], now: float
) -> float | None:
    """That of a stage none of whose tasks has a rate: the estimate, less what is done and has been waited."""
    if expected is None:
        trains = stage in (Stage.COARSE, Stage.BLOCK) or (stage is Stage.DISTRICT and tasks)
        return None if trains else 0.0
    waited = [now - task.since for task in left if task.status == Status.RUNNING and task.since]
    undone = _undone(left) / len(tasks) if tasks else 1.0
    return max(0.0, expected * undone - max(waited, default=0.0))


def _blocks_left(left: Sequence[TaskState]) -> float:
    """That of the blocks that are left, as long as the running ones, at the rate of all these together."""
    running = [task.progress for task in left if task.status == Status.RUNNING and task.progress]
    return _undone(left) * max(p.iterations for p in running) / sum(p.rate for p in running)


def _undone(tasks: Sequence[TaskState]) -> float:
    """How many tasks' work is left."""
    return sum(1 - share_of(task) for task in tasks)


def progress_of(state: RunState, info: Mapping[str, Any], prepared: float | None = None) -> float:
    """How much of the run's work is done, 0 to 1: iterations of Stage I and of blocks, and a little else.

    Args: info, run.json; prepared, how much of the preparation is done, None of a run that was given a scene.
    """
    if state.outcome == "done":
        return 1.0
    trained = _trained_share(state, info)
    return trained if prepared is None else _PREPARED * prepared + (1 - _PREPARED) * trained


def _trained_share(state: RunState, info: Mapping[str, Any]) -> float:
    """The same of all that comes after the preparation."""
    coarse = _coarse_share(state, info)
    if not setting(info, "refine", default=True):
        small = [share_of(state.task(MERGE)), _measured_share(state)]
        return (1 - _SMALL * len(small)) * coarse + _SMALL * sum(small)
    blocks = [share_of(state.task(TaskId.block(b.block))) for b in state.plan or () if b.train]
    count = len(blocks) if state.plan is not None else _block_count(info)
    scores = [share_of(task) for task in state.tasks.values() if task.id.stage is Stage.SCORE]
    small = [share_of(state.task(PLAN)), share_of(state.task(MERGE)), _measured_share(state)]
    small.append(sum(scores) / len(scores) if scores else 0.0)
    later, most = _later_share(state, info, count)
    trained = (coarse + sum(blocks) + later) / (1 + count + most)
    return (1 - _SMALL * len(small)) * trained + _SMALL * sum(small)


def _measured_share(state: RunState) -> float:
    """How much of the evaluation is done, 0 to 1."""
    shares = [share_of(state.task(task)) for task in state.measures or (EVAL,)]
    return sum(shares) / len(shares)


def _later_share(state: RunState, info: Mapping[str, Any], blocks: int) -> tuple[float, float]:
    """How much of the passes over the blocks' union is done, and how much there is: in blocks' trainings."""
    given = setting(info, "passes", default={})
    given = given if isinstance(given, dict) else {}
    parts = {stage: float(given.get(stage, 0)) for stage in (Stage.ROUND, Stage.REPAIR)}
    if state.plan is None:
        return 0.0, blocks * sum(parts.values())
    tasks = [task for tasks in state.passes for task in tasks]
    done = sum(parts[task.stage] * share_of(state.task(task)) for task in tasks)
    return done, sum(parts[task.stage] for task in tasks)


def _coarse_share(state: RunState, info: Mapping[str, Any]) -> float:
    """How much of Stage I is done, 0 to 1: of its districts, if there are several."""
    count = setting(info, "districts", default=1)
    if not isinstance(count, int) or count < 2 or state.status(COARSE) == Status.DONE:
        return share_of(state.task(COARSE))
    return sum(share_of(state.task(TaskId.district(i))) for i in range(count)) / count


def _block_count(info: Mapping[str, Any]) -> int:
    """How many blocks the settings request."""
    sizes = str(setting(info, "blocks", default="")).split("x")
    return prod(map(int, sizes)) if all(size.isdecimal() for size in sizes) else 1


def setting(info: Mapping[str, Any], key: str, *, default: Any) -> Any:
    """A setting of run.json, whatever that holds."""
    config = info.get("config")
    return config.get(key, default) if isinstance(config, dict) else default
