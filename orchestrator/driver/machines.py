"""The machines of a run, as its driver sees them from turn to turn."""

from collections.abc import Sequence

from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.resources import leaving, placement, quarantine
from panolog.orchestrator.resources.nodes import Node
from panolog.orchestrator.resources.pool import Pool
from panolog.orchestrator.run.clock import Clock
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.records import NodeLeaving


class Machines:
    """Which there are, which leave, and which are in quarantine."""

    def __init__(self, pool: Pool, journal: Journal, config: RunConfig, clock: Clock) -> None:
        self._pool = pool
        self._journal = journal
        self._config = config
        self._clock = clock

    def review(self) -> tuple[list[Node], bool]:
        """The nodes that can run tasks and do not leave, and whether others may be used than before.

        Records which nodes have announced that they leave, and quarantines.
        """
        there = self._pool.nodes()
        able = placement.able(there, cuda=self._config.device == "cuda")
        left = self._review_leaving(there, able)
        nodes = leaving.staying(self._journal.state, able)
        return nodes, self._review_quarantines(nodes) or left

    def leaves(self, node: str) -> str:
        """The host of a node if its tasks must move because it leaves, else "". Args: node, Node.id."""
        state = self._journal.state
        if not leaving.announced(state, node):
            return ""
        able = placement.able(self._pool.nodes(), cuda=self._config.device == "cuda")
        stays = any(other.id == node for other in leaving.staying(state, able))
        return "" if stays else state.nodes[node].host

    def _review_leaving(self, there: Sequence[Node], able: Sequence[Node]) -> bool:
        records = leaving.changes(self._journal.state, there, self._pool.notices())
        if records:
            self._journal.record(records)
            if any(isinstance(record, NodeLeaving) for record in records):
                self._journal.record(leaving.notice(self._journal.state, able))
        return bool(records)

    def _review_quarantines(self, nodes: Sequence[Node]) -> bool:
        state, config = self._journal.state, self._config.quarantine
        changes = quarantine.changes(state, nodes, config, self._clock.time())
        if changes:
            self._journal.record(changes)
            self._journal.record(quarantine.notice(self._journal.state, nodes, config))
        return bool(changes)
