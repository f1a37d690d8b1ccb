"""Which nodes have announced that they leave, and what that means: pure functions of a `RunState`.

A node that leaves gets no more tasks, and those that train there save a checkpoint and end, to continue
elsewhere. A rebalance recommendation has no date and may never come true: where no other node stays, it
changes nothing.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from panolog.orchestrator.runs.machines.history import Leave
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Failure, Leaving, NodeLeaving, NodeLeft, NodeStaying, Noticed
from panolog.orchestrator.runs.state import RunState


@dataclass(frozen=True)
class LeaveNotice:
    """What a node knows of its end before it comes."""

    kind: Leaving
    seconds: float | None = None  # until it leaves, from now on; None = not known

    def after(self, seconds: float) -> "LeaveNotice":
        """The same so many seconds later."""
        return self if self.seconds is None else replace(self, seconds=max(0.0, self.seconds - seconds))


def changes(
    state: RunState, nodes: Sequence[Node], notices: Mapping[str, LeaveNotice]
) -> list[NodeLeaving | NodeStaying | NodeLeft]:
    """What has changed since the last records of nodes that leave.

    Args: nodes, those that are there now; notices, those in force, by Node.id.
    """
    records: list[NodeLeaving | NodeStaying | NodeLeft] = []
    hosts = {node.id: node.host for node in nodes}
    for id, host in hosts.items():
        notice, known = notices.get(id), _leave(state, id)
        if notice is not None and (known is None or known.kind != notice.kind):
            records.append(NodeLeaving(id, host, notice.kind, notice.seconds))
        elif notice is None and known is not None:
            records.append(NodeStaying(id, host))
    return records + [NodeLeft(node.id, node.host) for node in state.leaving() if node.id not in hosts]


def staying(state: RunState, nodes: Iterable[Node]) -> list[Node]:
    """The nodes that tasks can still be placed on."""
    nodes = list(nodes)
    without = [node for node in nodes if _leave(state, node.id) is None]
    return without or [
        node for node in nodes if (leave := _leave(state, node.id)) and leave.kind == Leaving.REBALANCE
    ]


def announced(state: RunState, node: str) -> bool:
    """Whether a node leaves or has left as it had announced. Args: node, Node.id."""
    return _leave(state, node) is not None


def preempts(state: RunState, node: str, failure: Failure) -> bool:
    """Whether a failure is the loss of a node that had announced that it leaves."""
    return failure == Failure.LOST and announced(state, node)


def notice(state: RunState, nodes: Sequence[Node]) -> list[Noticed]:
    """What a user should read when all nodes leave. Args: nodes, those that are there."""
    if not nodes or staying(state, nodes):
        return []
    return [Noticed(None, "every machine leaves: the run waits for another one")]


def _leave(state: RunState, id: str) -> Leave | None:
    known = state.nodes.get(id)
    return known.leave if known else None
