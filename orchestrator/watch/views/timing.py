"""How far a run is and how long it still takes."""

from collections.abc import Sequence
from itertools import groupby

from panolog.orchestrator.runs.state import RunState, Status, TaskState
from panolog.workers.tasks import COARSE, Stage, TaskId

_WELL = 0.25  # of its iterations after which the mean rate of a task alone says how long it takes
_SLOWEST = 4.0  # times the estimate: beyond, it was not of this machine
_FORECAST = 0.02  # of a run's time from which on what is over says how long the rest takes


def tasks_of(state: RunState) -> list[TaskState]:
    """All tasks that are known, in the order of the stages; those of the plan also before they start."""
    tasks = set(state.tasks) | {TaskId.block(b.block) for b in state.plan or () if b.train}
    tasks.update(state.measures, *state.between)
    return [state.task(task) for task in sorted(tasks, key=lambda task: task.order)]


def share_of(task: TaskState) -> float:
    """How much of a task is done, 0 to 1."""
    if task.status == Status.DONE:
        return 1.0
    progress = task.progress
    return min(1.0, progress.iteration / progress.iterations) if progress and progress.iterations else 0.0


def eta_of(task: TaskState, now: float) -> float | None:
    """Seconds that a running task still needs; None of others, and before its first iterations.

    Args: now, epoch seconds.
    """
    whole = _whole(task, now)
    return None if whole is None else (1 - share_of(task)) * whole


def _whole(task: TaskState, now: float, expected: float | None = None) -> float | None:
    """Seconds of a running task for all of its iterations; None of others, and before its first ones.

    At first as expected, or else at its present rate, and the more it has done the more at its mean rate:
    the present one varies with all else that the machine does.

    Args: now, epoch seconds; expected, seconds of the same.
    """
    progress = task.progress
    if task.status != Status.RUNNING or progress is None or progress.rate <= 0:
        return None
    whole, done = expected or progress.iterations / progress.rate, progress.iteration - task.begun
    if task.since is None or done <= 0:
        return whole
    known = min(1.0, done / (_WELL * progress.iterations)) ** 2  # the time of a start weighs little
    return (1 - known) * whole + known * (now - task.since) * progress.iterations / done


def seconds_of(task: TaskState, now: float) -> float | None:
    """Seconds of all attempts at a task up to a time; None before the first. Args: now, epoch seconds."""
    if task.status == Status.RUNNING and task.since is not None:
        return task.spent + now - task.since
    return task.spent + (task.seconds or 0.0) or None


def run_eta(state: RunState, now: float, prepared: float | None = None) -> float | None:
    """Seconds until a run is done: its tasks at their present rates, what is to come as estimated before.

    Args: as `progress_of`. None if the run has ended or waits, or if a stage that trains has neither a rate
    nor an estimate, nor a preparation that has gone on for a while.
    """
    if state.outcome is not None or state.waiting:
        return None
    left, spent = _time_left(state, now), elapsed(state, now)
    if left is None and spent is not None and prepared is not None and prepared >= _FORECAST:
        return spent * (1 - prepared) / prepared
    return left


def elapsed(state: RunState, now: float) -> float | None:
    """Seconds in which a driver was at work on a run; None before the first. Args: now, epoch seconds."""
    return None if state.began is None else state.worked(state.began, state.ended or now)


def progress_of(state: RunState, now: float, prepared: float | None = None) -> float:
    """How much of a run's time is over, 0 to 1: elapsed ÷ (elapsed + left).

    It stands still while the run waits. Before the preflight, which estimates what is left, it is what the
    preparation says, or 0.

    Args: now, epoch seconds; prepared, `PreparationView.over`, None of a run that was given a scene.
    """
    if state.outcome == "done":
        return 1.0
    end = state.ended or (state.latest if state.waiting and state.latest is not None else now)
    spent, left = elapsed(state, end), _time_left(state, end)
    if spent is None or left is None:
        return prepared or 0.0
    return spent / (spent + left) if left > 0 else min(spent, 1.0)


def _time_left(state: RunState, now: float) -> float | None:
    """Seconds that the stages of a run still need; None if that of one is not known."""
    stages = [stage for stage in Stage if state.estimate is None or stage in state.estimate]
    tasks = {stage: list(of_stage) for stage, of_stage in groupby(tasks_of(state), lambda it: it.id.stage)}
    left = [_stage_left(state, stage, tasks.get(stage, []), now) for stage in stages]
    known = [seconds for seconds in left if seconds is not None]
    return sum(known) if len(known) == len(left) else None


def _stage_left(state: RunState, stage: Stage, tasks: Sequence[TaskState], now: float) -> float | None:
    """Seconds that a stage, with these tasks, still needs; None if that is not known."""
    left = [task for task in tasks if task.status not in (Status.DONE, Status.FAILED)]
    over = not left and (tasks or (stage is Stage.BLOCK and state.plan is not None))
    if stage is Stage.DISTRICT and tasks:
        over = state.status(COARSE) == Status.DONE
    if over:
        return 0.0
    expected = (state.estimate or {}).get(stage)
    if expected is not None and stage is not Stage.COARSE:
        expected *= _slowness(state, now)
    running = [task for task in left if task.status == Status.RUNNING and task.progress]
    each = None if expected is None or stage.in_shards else expected * len(running) / max(1, len(tasks))
    wholes = {task.id: whole for task in running if (whole := _whole(task, now, each)) is not None}
    if not wholes and not (stage is Stage.DISTRICT and tasks and expected is not None):
        return _expected_left(stage, expected, tasks, left, now)
    etas = [(1 - share_of(task)) * wholes[task.id] for task in running if task.id in wholes]
    if stage.refines:  # the others as long as those that run, one after another on their places
        return max(*etas, _undone(left) * sum(wholes.values()) / len(wholes) ** 2)
    if (stage is Stage.DISTRICT or stage.in_shards) and expected is not None:  # tasks that wait are not known
        began = min((task.since for task in tasks if task.since is not None), default=now)
        return max([*etas, 0.0, expected - (now - began)])
    return max(etas)


def _slowness(state: RunState, now: float) -> float:
    """How many times longer than estimated Stage I takes: what follows on the machines does too."""
    task, expected = state.task(COARSE), (state.estimate or {}).get(Stage.COARSE)
    taken = _whole(task, now, expected)
    if task.status == Status.DONE and task.seconds and task.iterations and task.iterations > task.begun:
        taken = task.seconds * task.iterations / (task.iterations - task.begun)
    return min(max(1 / _SLOWEST, taken / expected), _SLOWEST) if taken and expected else 1.0


def _expected_left(
    stage: Stage, expected: float | None, tasks: Sequence[TaskState], left: Sequence[TaskState], now: float
) -> float | None:
    """The time left of a stage without rates: the estimate, less what is done and has been waited."""
    if expected is None:
        trains = stage in (Stage.COARSE, Stage.BLOCK) or (stage is Stage.DISTRICT and tasks)
        return None if trains else 0.0
    waited = [now - task.since for task in left if task.status == Status.RUNNING and task.since]
    undone = _undone(left) / len(tasks) if tasks else 1.0
    return max(0.0, expected * undone - max(waited, default=0.0))


def _undone(tasks: Sequence[TaskState]) -> float:
    """How many tasks' work is left."""
    return sum(1 - share_of(task) for task in tasks)
