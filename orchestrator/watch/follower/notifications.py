"""What people are notified of: a pure function of a run's records.

A notification has an id that follows from the run and the record behind it, so that one that is sent twice,
which a kill between sending and noting can cause, is known as the same by who receives it.
"""

import hashlib
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from panolog.orchestrator.runs.machines.history import MACHINE_DIED, MACHINE_GONE, leave_text
from panolog.orchestrator.runs.money.records import BudgetNear
from panolog.orchestrator.runs.records import (
    Failure,
    Leaving,
    NodeLeaving,
    Outcome,
    RunBegan,
    Stored,
    TaskFailed,
    TaskStarted,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.runs.units import duration
from panolog.workers.tasks import StrEnum, TaskId

_LONGEST = 1000  # characters of a text
# Of these people are notified at once, of others once a task has to move: a node that drains may be idle.
_TAKEN = (Leaving.PREEMPTION, Leaving.TERMINATION, Leaving.MAINTENANCE)
_TOGETHER_S = 60.0  # losses on one node within so many seconds are one notification


class Kind(StrEnum):
    """What has happened."""

    DONE = "done"
    FAILED = "failed"
    STALLED = "stalled"
    PREEMPTED = "preempted"
    OVER_BUDGET = "over_budget"  # a limit of cost or time is near, or has ended a run early
    TEST = "test"


@dataclass(frozen=True)
class Notification:
    """One message to people."""

    id: str  # equal for every delivery of it
    kind: Kind
    time: float  # seconds since the epoch
    run: str  # name of the run folder
    text: str  # one line
    facts: dict[str, Any] = field(default_factory=dict)  # numbers and words, for programs
    record: int = 0  # Stored.id behind it

    @property
    def title(self) -> str:
        """What is read first."""
        return f"PanoLOG {self.run}: {str(self.kind).replace('_', ' ')}"


def run_id(records: Sequence[Stored]) -> str:
    """The identity of a run: of its first driver. "" if it has none yet. 16 hexadecimal digits."""
    first = next((item for item in records if isinstance(item.record, RunBegan)), None)
    if first is None or not isinstance(first.record, RunBegan):
        return ""
    text = f"{first.time!r}/{first.record.host}/{first.record.pid}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass
class Losses:
    """Finds the machines that leave or were lost, with their tasks, in records that come piece by piece."""

    starts: dict[TaskId, TaskStarted] = field(default_factory=dict)  # the latest of each task
    found: dict[int, tuple[float, str, list[str]]] = field(default_factory=dict)  # by the first record
    announced: dict[str, tuple[int, float, NodeLeaving]] = field(default_factory=dict)  # by node
    _leaving: dict[str, NodeLeaving] = field(default_factory=dict)  # by node
    _latest: dict[str, int] = field(default_factory=dict)  # by node: the first record of its latest group

    def add(self, records: Sequence[Stored]) -> None:
        """Takes later records, in order."""
        for item in records:
            record = item.record
            if isinstance(record, TaskStarted):
                self.starts[record.task] = record
            elif isinstance(record, NodeLeaving):
                self._leaving[record.node] = record
                if record.kind in _TAKEN:
                    self._announce(item, record.node)
            elif isinstance(record, TaskYielded) and record.leaves:
                self._announce(item, self.starts[record.task].node_id if record.task in self.starts else "")
            elif isinstance(record, TaskFailed) and _left(record) and record.node not in self.announced:
                self._note(item.id, item.time, record)

    def _announce(self, item: Stored, node: str) -> None:
        if node in self._leaving:
            self.announced.setdefault(node, (item.id, item.time, self._leaving[node]))

    def _note(self, id: int, time: float, record: TaskFailed) -> None:
        before = self._latest.get(record.node)
        if before is not None and time - self.found[before][0] <= _TOGETHER_S:
            self.found[before][2].append(str(record.task))
            return
        host = self.starts[record.task].node if record.task in self.starts else "a machine"
        self._latest[record.node] = id
        self.found[id] = (time, f"{host} ({record.node[:8]})" if record.node else host, [str(record.task)])

    def notifications(self, run: str, name: str) -> list[Notification]:
        """One for each machine that has left. Args: run, `run_id`; name, of the run folder."""
        return [
            _made(
                run, name, Kind.PREEMPTED, id, time, f"{node} has left; it worked on {', '.join(tasks)}",
                node=node, tasks=tasks,
            )
            for id, (time, node, tasks) in self.found.items()
        ] + [
            _made(
                run, name, Kind.PREEMPTED, id, time, leave_text(record),
                node=record.host, seconds=record.seconds,
            )
            for id, time, record in self.announced.values()
        ]  # fmt: skip


def _left(record: TaskFailed) -> bool:
    return record.kind == Failure.LOST and record.reason in (MACHINE_DIED, MACHINE_GONE)


def end_of(state: RunState, last: Stored | None, run: str, name: str) -> Notification | None:
    """Notifies that a run has ended, once no driver is at work on it; None if a user has stopped it.

    Args: last, the RunEnded or RunBegan that came last; run, `run_id`; name, of the run folder.
    """
    if last is None or state.outcome == Outcome.INTERRUPTED:
        return None
    seconds = None if state.began is None or state.latest is None else state.worked(state.began, state.latest)
    facts: dict[str, Any] = {"seconds": seconds}
    if state.outcome in (Outcome.DONE, Outcome.LIMITED):
        facts |= {
            "metrics": state.metrics or {},
            "gaussians": state.merged.gaussians if state.merged else None,
        }
        if state.outcome == Outcome.LIMITED:
            what = "a model of what there is is ready" if state.merged else "there is no model yet"
            facts["limit"] = state.reason
            text = f"ended early, {what}: {state.reason}"
            return _made(run, name, Kind.OVER_BUDGET, last.id, last.time, text + _measured(state), **facts)
        text = "the model is ready" + (f" after {duration(seconds)}" if seconds else "")
        return _made(run, name, Kind.DONE, last.id, last.time, text + _measured(state), **facts)
    why = (
        state.reason if state.outcome == Outcome.FAILED else "its driver has ended without a record: killed?"
    )
    return _made(run, name, Kind.FAILED, last.id, last.time, why or "no reason is known", **facts)


def _measured(state: RunState) -> str:
    values = {key: (state.metrics or {}).get(key) for key in ("psnr", "ssim")}
    shown = [f"{key.upper()} {value:.3g}" for key, value in values.items() if value is not None]
    return f" ({', '.join(shown)})" if shown else ""


def near_of(near: Stored, record: BudgetNear, run: str, name: str) -> Notification:
    """Notifies that a limit of cost or time is near. Args: near, the stored record; run, name as `end_of`."""
    return _made(run, name, Kind.OVER_BUDGET, near.id, near.time, f"soon: {record.what}", limit=record.what)


def stall_of(seconds: float, why: str, record: int, time: float, run: str, name: str) -> Notification:
    """Notifies that nothing has happened in a live run. Args: why, if it is known; record, the last."""
    text = f"nothing has happened for {duration(seconds)}" + (f": {why}" if why else "")
    return _made(run, name, Kind.STALLED, record, time, text, seconds=seconds)


def trial_of(name: str, id: str, time: float) -> Notification:
    """What `panolog notify test` sends. Args: id, its own each time."""
    return Notification(id, Kind.TEST, time, name, "this is a test: notifications of this run arrive here")


def _made(run: str, name: str, kind: Kind, record: int, time: float, text: str, **facts: Any) -> Notification:
    line = " ".join(text.split())[:_LONGEST]
    known = {"host": socket.gethostname()} | {key: value for key, value in facts.items() if value is not None}
    return Notification(f"{run}-{kind}-{record}", kind, time, name, line, known, record)
