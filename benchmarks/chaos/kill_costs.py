"""What kills have cost a run, computed from its history.

A kill costs the work that the tasks it ended had done since their last checkpoint, and the time until as many
tasks run again as before. Kills that come before the run has recovered from others count together.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from panolog.orchestrator.run.records import (
    CheckpointSaved,
    EvaluationSaved,
    Merged,
    ModelSaved,
    PlanSaved,
    Record,
    RunBegan,
    ScoresSaved,
    Stored,
    TaskFailed,
    TaskStarted,
)
from panolog.orchestrator.run.state import RunState, Status, replay
from panolog.workers.tasks import TaskId

Done = ModelSaved | ScoresSaved | PlanSaved | Merged | EvaluationSaved


@dataclass(frozen=True)
class Kill:
    """One SIGKILL."""

    time: float  # seconds since the epoch
    victim: str  # "driver", "worker" or "raylet"


@dataclass(frozen=True)
class KillCost:
    """The cost of one kill, or of several that came close together."""

    kills: tuple[Kill, ...]
    tasks: tuple[TaskId, ...]  # those that ended
    redone: float  # seconds of work that was not in a checkpoint
    recovery: float  # seconds until as many tasks ran again

    @property
    def seconds(self) -> float:
        """All of it."""
        return self.redone + self.recovery


def kill_costs(history: Sequence[Stored], kills: Sequence[Kill]) -> list[KillCost]:
    """The costs of all kills, in their order. Args: history of the whole run, to its end."""
    groups: list[KillCost] = []
    ends = [*(kill.time for kill in kills), float("inf")][1:]
    for kill, following in zip(kills, ends, strict=True):
        before = [stored for stored in history if stored.time <= kill.time]
        after = [stored for stored in history if stored.time > kill.time]
        state = replay(before)
        ended = _ended(state, (stored for stored in after if stored.time <= following), kill)
        redone = max((kill.time - _saved(before, task, kill) for task in ended), default=0.0)
        if kill.victim == "driver" and not ended and before:  # between two tasks, or at the start
            redone = kill.time - before[-1].time
        cost = KillCost((kill,), ended, redone, _recovered(state, ended, after, kill) - kill.time)
        last = groups[-1] if groups else None
        if last is not None and last.kills[0].time + last.recovery > kill.time:
            groups[-1] = _together(last, cost)
        else:
            groups.append(cost)
    return groups


def longest_unsaved(history: Sequence[Stored]) -> float:
    """The longest time for which a task's work was in no file, in an undisturbed run, in seconds."""
    times: dict[TaskId, list[float]] = {}
    for stored in history:
        if isinstance(stored.record, TaskStarted | CheckpointSaved | Done):
            times.setdefault(stored.record.task, []).append(stored.time)
    return max(after - before for task in times.values() for before, after in pairwise(task))


def _together(first: KillCost, second: KillCost) -> KillCost:
    end = max(first.kills[0].time + first.recovery, second.kills[0].time + second.recovery)
    tasks = tuple(dict.fromkeys((*first.tasks, *second.tasks)))
    recovery = end - first.kills[0].time
    return KillCost((*first.kills, *second.kills), tasks, first.redone + second.redone, recovery)


def _ended(state: RunState, meanwhile: Iterable[Stored], kill: Kill) -> tuple[TaskId, ...]:
    """The tasks that a kill ended: all of a driver; otherwise those that failed before the next kill."""
    if kill.victim == "driver":
        return tuple(_running(state))
    failed = [stored.record.task for stored in meanwhile if isinstance(stored.record, TaskFailed)]
    return tuple(dict.fromkeys(failed))


def _running(state: RunState) -> Iterator[TaskId]:
    return (name for name, task in state.tasks.items() if task.status == Status.RUNNING)


def _saved(before: Sequence[Stored], task: TaskId, kill: Kill) -> float:
    """Time of a task's last checkpoint or start; the time of the kill if it had not begun."""
    times = [
        stored.time
        for stored in before
        if stored.record.task == task and isinstance(stored.record, TaskStarted | CheckpointSaved)
    ]
    return max(times, default=kill.time)


def _recovered(state: RunState, ended: Sequence[TaskId], after: Sequence[Stored], kill: Kill) -> float:
    """When as many tasks ran again as before the kill, or all that it ended."""
    if not ended:
        return _next_step(after, kill) if kill.victim == "driver" else kill.time
    wanted = len(list(_running(state)))
    missing, alive = set(ended), set(_running(state)) - set(ended)
    for stored in after:
        _follow(alive, stored.record)
        if isinstance(stored.record, TaskStarted):
            missing.discard(stored.record.task)
        if isinstance(stored.record, TaskStarted) and (len(alive) >= wanted or not missing):
            return stored.time
    return after[-1].time if after else kill.time


def _follow(alive: set[TaskId], record: Record) -> None:
    if isinstance(record, TaskStarted):
        alive.add(record.task)
    elif isinstance(record, Done | TaskFailed):
        alive.discard(record.task)


def _next_step(after: Sequence[Stored], kill: Kill) -> float:
    """When a driver that was killed between two tasks was followed by a step of another."""
    steps = [stored.time for stored in after if not isinstance(stored.record, RunBegan)]
    return steps[0] if steps else kill.time
