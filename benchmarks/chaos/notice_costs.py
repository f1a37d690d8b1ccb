"""What a node that leaves has cost a run, computed from its history."""

from collections.abc import Sequence
from dataclasses import dataclass

from panolog.orchestrator.run.records import (
    NodeLeaving,
    Progressed,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.workers.tasks import TaskId

LIMIT_S = 5.0  # that a task may lose besides its checkpoint, if there was a notice


@dataclass(frozen=True)
class NoticeCost:
    """The cost of one node that has left; times in seconds."""

    task: TaskId  # that ran there
    noticed: float | None  # from the notice to its record; None = the node was gone before
    checkpoint: float | None  # from there to the end of the task with a checkpoint; None = it was lost
    elsewhere: float  # from the end of the task to its start on another node
    redone: int  # iterations that were trained twice
    lost: float  # from the record, without one from the notice, to that start, and what was trained twice

    def too_much(self) -> list[str]:
        """What the task may not have lost, after a notice."""
        lines = [f"{self.task} has trained {self.redone} iterations twice"] if self.redone else []
        allowed = (self.checkpoint or 0.0) + LIMIT_S
        if self.lost > allowed:
            lines.append(f"{self.task} has lost {self.lost:.1f} s of {allowed:.1f} s")
        return lines


def notice_cost(history: Sequence[Stored], node: str, time: float) -> NoticeCost | None:
    """The cost of the task that ran on a node when that got its notice; None if there was none.

    Args: node, Node.id; time of the notice in seconds since the epoch. Raises StopIteration if the task did
    not start again.
    """
    end = next(
        (stored for stored in history if stored.time >= time and _ends_on(stored, node, history)), None
    )
    if end is None or not isinstance(end.record, TaskYielded | TaskFailed):
        return None
    task = end.record.task
    of_task = [stored for stored in history if stored.record.task == task]
    again = next(s for s in of_task if s.id > end.id and isinstance(s.record, TaskStarted))
    first = next(s for s in reversed(of_task) if s.id < end.id and isinstance(s.record, TaskStarted))
    progress = [s for s in of_task if first.id < s.id < end.id and isinstance(s.record, Progressed)]
    record = (s.time for s in history if isinstance(s.record, NodeLeaving) and s.record.node == node)
    noticed = next((when for when in record if when <= end.time), None)
    redone, seconds = _redone(first, progress, again)
    return NoticeCost(
        task,
        None if noticed is None else noticed - time,
        None if noticed is None or isinstance(end.record, TaskFailed) else end.time - noticed,
        again.time - end.time,
        redone,
        again.time - (time if noticed is None else noticed) + seconds,
    )


def _ends_on(stored: Stored, node: str, history: Sequence[Stored]) -> bool:
    """Whether a record ends an attempt on a node."""
    if not isinstance(stored.record, TaskYielded | TaskFailed):
        return False
    task = stored.record.task
    starts = [s.record for s in history if isinstance(s.record, TaskStarted) and s.id < stored.id]
    mine = [record for record in starts if record.task == task]
    return bool(mine) and mine[-1].node_id == node


def _redone(first: Stored, progress: Sequence[Stored], again: Stored) -> tuple[int, float]:
    """Iterations that an attempt has done in vain, and the seconds that they took."""
    assert isinstance(first.record, TaskStarted) and isinstance(again.record, TaskStarted)
    if not progress or not isinstance(progress[-1].record, Progressed):
        return 0, 0.0
    reached, since = progress[-1].record.iteration, first.record.iteration
    redone = max(0, reached - again.record.iteration)
    return redone, redone * (progress[-1].time - first.time) / max(1, reached - since)
