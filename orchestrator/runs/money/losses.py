"""What of the work of a run is lost when an attempt or a driver ends."""

from panolog.orchestrator.runs.money.records import WorkLost
from panolog.orchestrator.runs.money.spending import Spending
from panolog.orchestrator.runs.state import RunState, Status, TaskState


def lost_at(task: TaskState, end: float) -> list[WorkLost]:
    """What is lost of a task whose attempt ends then, seconds since the epoch, without a checkpoint."""
    if task.status != Status.RUNNING or task.since is None:
        return []
    since = max(task.since, task.saved or task.since)
    return [WorkLost(task.id, max(0.0, end - since), end)]


def lost_with_driver(state: RunState) -> list[WorkLost]:
    """What the last driver of a run has lost by ending."""
    end = state.ended or state.latest
    return [] if end is None else [lost for task in state.tasks.values() for lost in lost_at(task, end)]


def settled(state: RunState, end: float, *, running: bool) -> Spending:
    """The account of a run up to a time, with what a driver has lost that is gone.

    Args: end, seconds since the epoch; running, whether a driver works on the run.
    """
    if running:
        return state.money.until(end)
    return state.money.with_lost(lost_with_driver(state)).until(state.ended or state.latest or end)
