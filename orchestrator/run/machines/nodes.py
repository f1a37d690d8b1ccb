"""What has happened on each node: failures of different tasks, quarantines, and whether it leaves.

A failure is the node's or the task's, and one alone does not show whose. So those of different tasks count
against a node until something succeeds there. Where a task has failed in the same way on another node, whose
last attempt before had succeeded, the cause is the task. What is lost with a node that has announced that it
leaves is a failure of neither.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from panolog.orchestrator.run.records import (
    CheckpointSaved,
    EvaluationSaved,
    Failure,
    Leaving,
    MeasuresSaved,
    ModelSaved,
    NodeLeaving,
    NodeLeft,
    NodeQuarantined,
    NodeReleased,
    NodeStaying,
    Record,
    ScoresSaved,
    TaskFailed,
)
from panolog.orchestrator.run.units import duration
from panolog.workers.tasks import TaskId

# Why attempts failed whose machine was taken away, as `TaskFailed.reason`.
MACHINE_DIED = "the worker's machine died or cannot be reached"
MACHINE_GONE = "the machine died before the worker began"


@dataclass(frozen=True)
class TaskFailure:
    """The last failure of a task on a node."""

    task: TaskId
    reason: str


@dataclass(frozen=True)
class Leave:
    """That a node leaves, or has left after it had announced that."""

    kind: Leaving
    until: float | None = None  # seconds since the epoch at which it leaves; None = not known
    over: bool = False  # it has left


@dataclass(frozen=True)
class NodeState:
    """One node, as far as something has happened there."""

    id: str  # Node.id
    host: str = ""  # of one in quarantine or that leaves
    failures: tuple[TaskFailure, ...] = ()  # of different tasks since the last success
    sound: bool = False  # what happened there last was a success
    until: float | None = None  # seconds since the epoch; None = it is not in quarantine
    reason: str = ""  # of its quarantine
    quarantines: int = 0  # since the last success
    leave: Leave | None = None


Nodes = Mapping[str, NodeState]  # by Node.id


def by_host(nodes: Iterable[NodeState]) -> tuple[NodeState, ...]:
    """Those nodes in the order of their hosts."""
    return tuple(sorted(nodes, key=lambda node: (node.host, node.id)))


_WHY = {
    Leaving.PREEMPTION: "its provider takes it away",
    Leaving.TERMINATION: "its owner has it deleted",
    Leaving.MAINTENANCE: "its provider stops it for maintenance",
    Leaving.REBALANCE: "its provider will probably take it away",
    Leaving.DRAIN: "Ray drains it",
}


def why_leaving(kind: Leaving) -> str:
    """Why a node leaves, and what follows from it, for people."""
    sole = " if another machine stays" if kind == Leaving.REBALANCE else ""
    return f"{_WHY[kind]}; tasks there save a checkpoint and move{sole}"


def leave_text(record: NodeLeaving) -> str:
    """For people, that a node leaves."""
    when = "" if record.seconds is None else f" in {duration(record.seconds)}"
    return f"{record.host} ({record.node[:8]}) leaves{when}: {why_leaving(record.kind)}"


def follow(nodes: Nodes, record: Record, where: str, time: float) -> Nodes:
    """The nodes after a record; the same object if it changes nothing of them.

    Args: where, Node.id of the latest attempt at the record's task; time of the record, epoch seconds.
    """
    match record:
        case TaskFailed():
            return _after_failure(nodes, record)
        case CheckpointSaved() | ModelSaved() | ScoresSaved() | MeasuresSaved() | EvaluationSaved():
            return _after_success(nodes, where)
        case NodeQuarantined():
            return _quarantine(nodes, record)
        case NodeReleased():
            here = nodes.get(record.node) or NodeState(record.node)
            return {**nodes, here.id: replace(here, failures=(), until=None, reason="")}
        case NodeLeaving():
            until = None if record.seconds is None else time + record.seconds
            return _leave(nodes, record, Leave(record.kind, until))
        case NodeStaying():
            return _leave(nodes, record, None)
        case NodeLeft():
            known = nodes.get(record.node)
            leave = known.leave if known else None
            return _leave(nodes, record, replace(leave, over=True) if leave else None)
    return nodes


def _leave(nodes: Nodes, record: NodeLeaving | NodeStaying | NodeLeft, leave: Leave | None) -> Nodes:
    here = nodes.get(record.node) or NodeState(record.node)
    return {**nodes, here.id: replace(here, host=record.host, leave=leave)}


def _after_failure(nodes: Nodes, record: TaskFailed) -> Nodes:
    """A shortage of memory counts against no node, nor does wrong input."""
    if not record.node or record.kind == Failure.MEMORY or record.preempted:
        return nodes
    here = nodes.get(record.node) or NodeState(record.node)
    failure = TaskFailure(record.task, record.reason)
    repeated = any(failure in node.failures for node in nodes.values() if node.id != here.id)
    if (repeated and here.sound) or (record.kind == Failure.INPUT and record.final):
        nodes = {id: replace(node, failures=_without(node, record.task)) for id, node in nodes.items()}
        return {**nodes, here.id: replace(here, failures=_without(here, record.task), sound=False)}
    return {**nodes, here.id: replace(here, failures=(*_without(here, record.task), failure), sound=False)}


def _after_success(nodes: Nodes, id: str) -> Nodes:
    """After a checkpoint or a result of a task."""
    here = nodes.get(id) or NodeState(id)
    after = replace(here, failures=here.failures if here.until else (), sound=True, quarantines=0)
    return nodes if after == here or not id else {**nodes, id: after}


def _quarantine(nodes: Nodes, record: NodeQuarantined) -> Nodes:
    here = nodes.get(record.node) or NodeState(record.node)
    count = here.quarantines + 1
    here = replace(here, host=record.host, until=record.until, reason=record.reason, quarantines=count)
    return {**nodes, here.id: here}


def take_over(nodes: Nodes) -> Nodes:
    """The nodes as a new driver finds them: quarantines hold, all else begins anew.

    It learns itself which nodes leave.
    """
    return {id: replace(node, leave=None) for id, node in nodes.items() if node.until is not None}


def _without(node: NodeState, task: TaskId) -> tuple[TaskFailure, ...]:
    return tuple(failure for failure in node.failures if failure.task != task)
