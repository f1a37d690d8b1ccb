"""What has happened on each node: failures of different tasks, and quarantines.

A failure is the node's or the task's, and one alone does not show whose. So those of different tasks count
against a node until something succeeds there. Where a task has failed in the same way on another node, whose
last attempt before had succeeded, the cause is the task.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from panolog.orchestrator.run.records import Failure, NodeQuarantined, TaskFailed
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
class NodeState:
    """One node, as far as something has happened there."""

    id: str  # Node.id
    host: str = ""  # of one in quarantine
    failures: tuple[TaskFailure, ...] = ()  # of different tasks since the last success
    sound: bool = False  # what happened there last was a success
    until: float | None = None  # seconds since the epoch; None = it is not in quarantine
    reason: str = ""  # of its quarantine
    quarantines: int = 0  # since the last success


Nodes = Mapping[str, NodeState]  # by Node.id


def after_failure(nodes: Nodes, record: TaskFailed) -> Nodes:
    """The nodes after a failed attempt. A shortage of memory counts against no node, nor does wrong input."""
    if not record.node or record.kind == Failure.MEMORY:
        return nodes
    here = nodes.get(record.node) or NodeState(record.node)
    failure = TaskFailure(record.task, record.reason)
    repeated = any(failure in node.failures for node in nodes.values() if node.id != here.id)
    if (repeated and here.sound) or (record.kind == Failure.INPUT and record.final):
        nodes = {id: replace(node, failures=_without(node, record.task)) for id, node in nodes.items()}
        return {**nodes, here.id: replace(here, failures=_without(here, record.task), sound=False)}
    return {**nodes, here.id: replace(here, failures=(*_without(here, record.task), failure), sound=False)}


def after_success(nodes: Nodes, id: str) -> Nodes:
    """The nodes after a checkpoint or a result of a task on one of them."""
    here = nodes.get(id) or NodeState(id)
    after = replace(here, failures=here.failures if here.until else (), sound=True, quarantines=0)
    return nodes if after == here or not id else {**nodes, id: after}


def quarantine(nodes: Nodes, record: NodeQuarantined) -> Nodes:
    """The nodes after one was put into quarantine."""
    here = nodes.get(record.node) or NodeState(record.node)
    count = here.quarantines + 1
    here = replace(here, host=record.host, until=record.until, reason=record.reason, quarantines=count)
    return {**nodes, here.id: here}


def release(nodes: Nodes, id: str) -> Nodes:
    """The nodes after one was released."""
    here = nodes.get(id) or NodeState(id)
    return {**nodes, id: replace(here, failures=(), until=None, reason="")}


def take_over(nodes: Nodes) -> Nodes:
    """The nodes as a new driver finds them: quarantines hold, all else begins anew."""
    return {id: node for id, node in nodes.items() if node.until is not None}


def _without(node: NodeState, task: TaskId) -> tuple[TaskFailure, ...]:
    return tuple(failure for failure in node.failures if failure.task != task)
