"""Which nodes and GPUs are put into quarantine and when they leave it: pure functions of a `RunState`.

One on which `quarantine.failures` different tasks have failed without a success gets no task until
`quarantine.seconds` have passed or a user releases it. A GPU of several is quarantined alone, as long as what
failed on its node failed there; the last place that is left only if tasks fail there alike. If all are in
quarantine, the cause is hardly a machine: the run waits `_SHARE` of the time and releases all, `_ROUNDS`
times, and fails if nothing has succeeded by then.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from panolog.orchestrator.runs.machines.config import QuarantineConfig
from panolog.orchestrator.runs.machines.history import NodeState
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Failure, NodeQuarantined, NodeReleased, Noticed
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.runs.units import duration
from panolog.workers.tasks import TaskId

_ROUNDS = 6  # quarantines of all nodes, without a success in between, after which the run fails
_SHARE = 1 / 6  # of `quarantine.seconds`, for which all nodes are in quarantine
_DIGITS = re.compile(r"\d+")  # reasons that differ in these are alike


def usable(state: RunState, nodes: Iterable[Node]) -> list[Node]:
    """The nodes that are not in quarantine, with their GPUs that are marked."""
    shut, found = {known.id for known in state.quarantined()}, list[Node]()
    for node in nodes:
        closed = tuple(gpu for gpu in range(len(node.gpus)) if node.card(gpu) in shut) if shut else ()
        if node.id not in shut and (len(closed) < len(node.gpus) or not node.gpus):
            found.append(node if closed == node.closed else replace(node, closed=closed))
    return found


def changes(
    state: RunState, nodes: Sequence[Node], config: QuarantineConfig, now: float
) -> list[NodeQuarantined | NodeReleased]:
    """Which nodes and GPUs are put into quarantine or released now.

    Args: nodes, those that are there and can run tasks of this run; now, seconds since the epoch.
    """
    left = usable(state, nodes)
    bad = [*_bad_cards(state, left, config.failures)] or [*_bad_nodes(state, left, config.failures)]
    records: list[NodeQuarantined | NodeReleased] = [
        _quarantine(state, known, host, now + config.seconds) for known, host in bad
    ]
    if records:
        return records
    shortened = (1 - _SHARE) * config.seconds if nodes and not left else 0.0
    for known in state.quarantined():
        remains = (known.until or now) - shortened - now
        if len(known.failures) < config.failures:
            records.append(
                NodeReleased(known.id, known.host, "the tasks have failed elsewhere in the same way")
            )
        elif not 0 < remains <= config.seconds + 1:  # the latter if the clock was set back
            records.append(NodeReleased(known.id, known.host, "its time is over"))
    return records


def _bad_cards(state: RunState, nodes: Sequence[Node], failures: int) -> Iterator[tuple[NodeState, str]]:
    """GPUs on which alone tasks have failed, of nodes with others that are not in quarantine."""
    for node in nodes:
        cards = [gpu for gpu in range(len(node.gpus)) if gpu not in node.closed]
        for gpu in cards if len(cards) > 1 else ():
            known = state.nodes.get(node.card(gpu))
            if known is not None and len(known.failures) >= failures:
                yield known, f"{node.host}, GPU {gpu}"


def _bad_nodes(state: RunState, nodes: Sequence[Node], failures: int) -> Iterator[tuple[NodeState, str]]:
    """Nodes on which tasks have failed, on more than one GPU if there are several."""
    for node in nodes:
        known = state.nodes.get(node.id)
        if known is None or len(known.failures) < failures:
            continue
        cards = {failure.card for failure in known.failures}
        spread = len(node.gpus) - len(node.closed) < 2 or len(cards) > 1 or "" in cards
        alike = len({_DIGITS.sub("", failure.reason) for failure in known.failures}) == 1
        if spread and (alike or len(nodes) > 1):
            yield known, node.host


def excuses(state: RunState, where: Iterable[str], failure: Failure) -> bool:
    """Whether a failure does not count against its task, because its place is in quarantine.

    Args: where, Node.id and Node.card of the attempt.
    """
    return failure != Failure.MEMORY and any(_until(state, id) for id in where)


def waiting(state: RunState, nodes: Sequence[Node]) -> str | None:
    """Why nothing can start: all nodes are in quarantine. None if one is not."""
    if not nodes or usable(state, nodes):
        return None
    first = min(_in_quarantine(state, nodes), key=lambda known: known.until or 0.0)
    return f"every machine is in quarantine; {first.host}: {first.reason}"


def notice(state: RunState, nodes: Sequence[Node], config: QuarantineConfig) -> list[Noticed]:
    """What a user should read when all nodes are in quarantine."""
    why = waiting(state, nodes)
    later = f"the run waits, and all are used again after {duration(_SHARE * config.seconds)}"
    return [Noticed(None, f"{why}; {later}")] if why else []


def hopeless(state: RunState, ready: Sequence[TaskId], nodes: Sequence[Node]) -> str | None:
    """Why no node will do for the tasks that are ready; None while there is hope."""
    why = waiting(state, nodes)
    if not ready or why is None:
        return None
    if any(known.quarantines < _ROUNDS for known in _in_quarantine(state, nodes)):
        return None
    return f"{why}; {_ROUNDS} times without a success in between"


def _until(state: RunState, id: str) -> float | None:
    known = state.nodes.get(id)
    return None if known is None else known.until


def _in_quarantine(state: RunState, nodes: Sequence[Node]) -> list[NodeState]:
    """What is in quarantine of some nodes: they or their GPUs."""
    ids = [id for node in nodes for id in (node.id, *map(node.card, range(len(node.gpus))))]
    return [state.nodes[id] for id in ids if _until(state, id)]


def _quarantine(state: RunState, known: NodeState, host: str, until: float) -> NodeQuarantined:
    tasks = [
        str(task.id)
        for task in state.tasks.values()
        if any(known.id in failure.where for failure in task.failures)
    ]
    last = known.failures[-1]
    reason = (
        f"{len(known.failures)} tasks have failed there in a row, the last one, {last.task}: {last.reason}"
    )
    return NodeQuarantined(known.id, host, reason, until, tuple(tasks))
