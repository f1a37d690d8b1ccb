"""Which nodes are put into quarantine and when they leave it: pure functions of a `RunState`.

A node on which `quarantine.failures` different tasks have failed without a success gets no task until
`quarantine.seconds` have passed or a user releases it. Where there is no other node, none is put into
quarantine: whether the tasks or the node are the cause cannot be seen, and the failures count.

If all nodes are in quarantine, the cause is hardly a node: a mount, a switch, the code. The run then waits
`_SHARE` of the time and releases all, `_ROUNDS` times; if nothing has succeeded by then it fails.
"""

from collections.abc import Iterable, Sequence

from panolog.orchestrator.resources.nodes import Node
from panolog.orchestrator.run.machines.config import QuarantineConfig
from panolog.orchestrator.run.machines.nodes import NodeState
from panolog.orchestrator.run.records import Failure, NodeQuarantined, NodeReleased, Noticed
from panolog.orchestrator.run.state import RunState
from panolog.orchestrator.run.units import duration
from panolog.workers.tasks import TaskId

_ROUNDS = 6  # quarantines of all nodes, without a success in between, after which the run fails
_SHARE = 1 / 6  # of `quarantine.seconds`, for which all nodes are in quarantine


def usable(state: RunState, nodes: Iterable[Node]) -> list[Node]:
    """The nodes that are not in quarantine."""
    return [node for node in nodes if not _quarantined(state, node)]


def changes(
    state: RunState, nodes: Sequence[Node], config: QuarantineConfig, now: float
) -> list[NodeQuarantined | NodeReleased]:
    """Which nodes are put into quarantine or released now.

    Args: nodes, those that are there and can run tasks of this run; now, seconds since the epoch.
    """
    records: list[NodeQuarantined | NodeReleased] = []
    for node in usable(state, nodes) if len(nodes) > 1 else ():
        known = state.nodes.get(node.id)
        if known is not None and len(known.failures) >= config.failures:
            records.append(_quarantine(state, known, node.host, now + config.seconds))
    if records:
        return records
    shortened = (1 - _SHARE) * config.seconds if nodes and not usable(state, nodes) else 0.0
    for known in state.quarantined():
        left = (known.until or now) - shortened - now
        if len(known.failures) < config.failures:
            records.append(
                NodeReleased(known.id, known.host, "the tasks have failed elsewhere in the same way")
            )
        elif not 0 < left <= config.seconds + 1:  # the latter if the clock was set back
            records.append(NodeReleased(known.id, known.host, "its time is over"))
    return records


def excuses(state: RunState, node: str, failure: Failure) -> bool:
    """Whether a failure does not count against its task, because its node is in quarantine."""
    known = state.nodes.get(node)
    return known is not None and known.until is not None and failure != Failure.MEMORY


def waiting(state: RunState, nodes: Sequence[Node]) -> str | None:
    """Why nothing can start: all nodes are in quarantine. None if one is not."""
    if not nodes or usable(state, nodes):
        return None
    first = min((state.nodes[node.id] for node in nodes), key=lambda known: known.until or 0.0)
    return f"every machine is in quarantine, {first.host} because {first.reason}"


def notice(state: RunState, nodes: Sequence[Node], config: QuarantineConfig) -> list[Noticed]:
    """What a user should read when all nodes are in quarantine."""
    why = waiting(state, nodes)
    later = f"the run waits, and all are used again after {duration(_SHARE * config.seconds)}"
    return [Noticed(None, f"{why}; {later}")] if why else []


def hopeless(state: RunState, ready: Sequence[TaskId], nodes: Sequence[Node]) -> str | None:
    """Why no node will do for the tasks that are ready; None while there is hope."""
    why = waiting(state, nodes)
    if not ready or why is None or any(state.nodes[node.id].quarantines < _ROUNDS for node in nodes):
        return None
    return f"{why}; {_ROUNDS} times without a success in between"


def _quarantined(state: RunState, node: Node) -> bool:
    known = state.nodes.get(node.id)
    return known is not None and known.until is not None


def _quarantine(state: RunState, known: NodeState, host: str, until: float) -> NodeQuarantined:
    tasks = [str(task.id) for task in state.tasks.values() if known.id in {node for node, _ in task.failures}]
    last = known.failures[-1]
    reason = (
        f"{len(known.failures)} tasks have failed there in a row, the last one, {last.task}: {last.reason}"
    )
    return NodeQuarantined(known.id, host, reason, until, tuple(tasks))
