"""Which nodes have announced that they leave, and what that means: pure functions of a `RunState`.

A node that leaves gets no more tasks, and those that train there save a checkpoint and end, to continue
elsewhere. A rebalance recommendation has no date and may never come true: where no other node stays, it
changes nothing.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from panolog.orchestrator.runs.machines.history import leave_of
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Leaving, NodeLeaving, NodeLeft, NodeStaying, Noticed
from panolog.orchestrator.runs.state import RunState


@dataclass(frozen=True)
class LeaveNotice:
    """What a node knows of its end before it comes."""

    kind: Leaving
    seconds: float | None = None  # until it leaves, from now on; None = not known

    def after(self, seconds: float) -> "LeaveNotice":
        """This notice `seconds` later."""
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
        notice, known = notices.get(id), leave_of(state.nodes, id)
        if notice is not None and (known is None or known.kind != notice.kind):
            records.append(NodeLeaving(id, host, notice.kind, notice.seconds))
        elif notice is None and known is not None:
            records.append(NodeStaying(id, host))
    return records + [NodeLeft(node.id, node.host) for node in state.leaving() if node.id not in hosts]


def staying(state: RunState, nodes: Iterable[Node]) -> list[Node]:
    """The nodes that tasks can still be placed on."""
    nodes = list(nodes)
    without = [node for node in nodes if leave_of(state.nodes, node.id) is None]
    return without or [
        node
        for node in nodes
        if (leave := leave_of(state.nodes, node.id)) and leave.kind == Leaving.REBALANCE
    ]


def notice(state: RunState, nodes: Sequence[Node]) -> list[Noticed]:
    """What a user should read when all nodes leave. Args: nodes, those that are there."""
    if not nodes or staying(state, nodes):
        return []
    return [Noticed(None, "every machine leaves: the run waits for another one")]
