"""What has happened on each node and GPU: failures of different tasks, quarantines, whether a node leaves.

Failures of different tasks count against a node, and against its GPU, until something succeeds there. Where a
task has failed in the same way at another place, whose last attempt before had succeeded, the cause is the
task. What is lost with a node that has announced that it leaves is a failure of neither.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from panolog.orchestrator.runs.records import (
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
from panolog.orchestrator.runs.units import duration
from panolog.workers.tasks import TaskId

# Why attempts failed whose machine was taken away, as `TaskFailed.reason`.
MACHINE_DIED = "the worker's machine died or cannot be reached"
MACHINE_GONE = "the machine died before the worker began"


@dataclass(frozen=True)
class TaskFailure:
    """The last failure of a task at a place."""

    task: TaskId
    reason: str
    card: str = field(default="", compare=False)  # Node.card of its GPU


@dataclass(frozen=True)
class Misfortune:
    """A failure of a task, of which its place may be the cause."""

    kind: Failure
    where: tuple[str, str]  # Node.id and Node.card


@dataclass(frozen=True)
class Leave:
    """A node's announced end: it leaves, or has left."""

    kind: Leaving
    until: float | None = None  # seconds since the epoch at which it leaves; None = not known
    over: bool = False  # it has left


@dataclass(frozen=True)
class NodeState:
    """One node or GPU, as far as something has happened there."""

    id: str  # Node.id or Node.card
    host: str = ""  # of one in quarantine or that leaves, with the GPU if it is one
    failures: tuple[TaskFailure, ...] = ()  # of different tasks since the last success
    sound: bool = False  # what happened there last was a success
    until: float | None = None  # seconds since the epoch; None = it is not in quarantine
    reason: str = ""  # of its quarantine
    quarantines: int = 0  # since the last success
    leave: Leave | None = None


Nodes = Mapping[str, NodeState]  # by Node.id or Node.card


def by_host(nodes: Iterable[NodeState]) -> tuple[NodeState, ...]:
    """The given nodes in the order of their hosts."""
    return tuple(sorted(nodes, key=lambda node: (node.host, node.id)))


def leave_of(nodes: Nodes, id: str) -> Leave | None:
    """What a node that leaves, or has left, has announced; None of any other node. Args: id, Node.id."""
    known = nodes.get(id)
    return known.leave if known else None


def leaves_for_sure(nodes: Iterable[NodeState], host: str) -> bool:
    """Whether a machine is among those that leave, and not only probably."""
    leaves = (node.leave for node in nodes if node.host == host)
    return any(leave is not None and leave.kind != Leaving.REBALANCE for leave in leaves)


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


def follow(nodes: Nodes, record: Record, where: Iterable[str], time: float) -> Nodes:
    """The nodes after a record; the same object if it changes nothing of them.

    Args: where, Node.id and Node.card of the latest attempt at the record's task; time of the record, epoch
    seconds.
    """
    match record:
        case TaskFailed():
            return _after_failure(nodes, record)
        case CheckpointSaved() | ModelSaved() | ScoresSaved() | MeasuresSaved() | EvaluationSaved():
            for id in filter(None, where):
                nodes = _after_success(nodes, id)
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
            leave = leave_of(nodes, record.node)
            return _leave(nodes, record, replace(leave, over=True) if leave else None)
    return nodes


def _leave(nodes: Nodes, record: NodeLeaving | NodeStaying | NodeLeft, leave: Leave | None) -> Nodes:
    here = nodes.get(record.node) or NodeState(record.node)
    return {**nodes, here.id: replace(here, host=record.host, leave=leave)}


def _after_failure(nodes: Nodes, record: TaskFailed) -> Nodes:
    """A shortage of memory counts against no place, nor does wrong input."""
    if not record.node or record.kind == Failure.MEMORY or record.preempted:
        return nodes
    failure, changed = TaskFailure(record.task, record.reason, record.card), dict(nodes)
    for here in filter(None, (record.node, record.card)):
        known = nodes.get(here) or NodeState(here)
        elsewhere = (node for id, node in nodes.items() if id not in (record.node, record.card))
        repeated = known.sound and any(failure in node.failures for node in elsewhere)
        if repeated or (record.kind == Failure.INPUT and record.final):
            changed = {id: replace(it, failures=_without(it, record.task)) for id, it in changed.items()}
            changed[here] = replace(known, failures=_without(known, record.task), sound=False)
        else:
            changed[here] = replace(known, failures=(*_without(known, record.task), failure), sound=False)
    return changed


def _after_success(nodes: Nodes, id: str) -> Nodes:
    here = nodes.get(id) or NodeState(id)
    after = replace(here, failures=here.failures if here.until else (), sound=True, quarantines=0)
    return nodes if after == here else {**nodes, id: after}


def _quarantine(nodes: Nodes, record: NodeQuarantined) -> Nodes:
    """What has failed on a GPU does not count against its node any more."""
    others = {
        id: replace(node, failures=tuple(it for it in node.failures if it.card != record.node))
        for id, node in nodes.items()
    }
    here = nodes.get(record.node) or NodeState(record.node)
    count = here.quarantines + 1
    here = replace(here, host=record.host, until=record.until, reason=record.reason, quarantines=count)
    return {**others, here.id: here}


def take_over(nodes: Nodes) -> Nodes:
    """The nodes as a new driver finds them: quarantines hold, all else begins anew.

    It learns itself which nodes leave.
    """
    return {id: replace(node, leave=None) for id, node in nodes.items() if node.until is not None}


def _without(node: NodeState, task: TaskId) -> tuple[TaskFailure, ...]:
    return tuple(failure for failure in node.failures if failure.task != task)
