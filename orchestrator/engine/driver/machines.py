"""The machines of a run, as its driver sees them from turn to turn."""

from collections.abc import Mapping, Sequence
from datetime import datetime

from panolog.orchestrator.engine.driver.demands import Demands
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.engine.driver.journal import Journal
from panolog.orchestrator.engine.estimates.calibration import basis_of
from panolog.orchestrator.engine.scheduling import leaving, placement, quarantine
from panolog.orchestrator.engine.scheduling.expected import Coming, Expected
from panolog.orchestrator.engine.scheduling.placement import Placed, Running
from panolog.orchestrator.engine.scheduling.pool import Pool
from panolog.orchestrator.engine.scheduling.scaling import IDLE_S, Growth, Work
from panolog.orchestrator.runs.clock import Clock
from panolog.orchestrator.runs.machines.history import leave_of
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.money.prices import price_by, prices_of
from panolog.orchestrator.runs.records import NodeLeaving, Noticed
from panolog.workers.tasks import TaskId

_NAMED = 6  # paused blocks that are named one by one


class Machines:
    """Which there are, which leave, which are in quarantine, and which are on their way."""

    def __init__(self, pool: Pool, journal: Journal, job: Job, clock: Clock) -> None:
        self._pool = pool
        self._journal = journal
        self._config = job.config
        self._clock = clock
        self._expected = Expected(clock, basis_of(job.folder, job.scene, job.config).joined)

    @property
    def _cuda(self) -> bool:
        return self._config.device == "cuda"

    def review(self) -> tuple[list[Node], bool]:
        """The nodes that can run tasks and do not leave, and whether others may be used than before.

        Records which nodes have announced that they leave, and quarantines.
        """
        there = self._pool.nodes()
        able = placement.able(there, cuda=self._cuda)
        left = self._review_leaving(there, able)
        nodes = leaving.staying(self._journal.state, able)
        return nodes, self._review_quarantines(nodes) or left

    def leaves(self, node: str) -> str:
        """The host of a node if its tasks must move because it leaves, else "". Args: node, Node.id."""
        state = self._journal.state
        if leave_of(state.nodes, node) is None:
            return ""
        able = placement.able(self._pool.nodes(), cuda=self._cuda)
        stays = any(other.id == node for other in leaving.staying(state, able))
        return "" if stays else state.nodes[node].host

    def place(
        self, demands: Demands, tasks: Sequence[TaskId], running: Sequence[Running], nodes: Sequence[Node]
    ) -> list[Placed]:
        """The tasks that start now; requests the machines that the others should have.

        Args: tasks, all that wait; running, what runs; nodes that can be used.
        """
        growth, come = self._pool.growth(), Coming()
        if growth.groups:
            work = demands.work(tasks)
            waiting, come = work.demands, self._grow(growth, work, running, nodes)
        else:  # no need to know how long the stage takes
            waiting = demands.of(tasks)
        every, busy = [*nodes, *come.nodes], [*running, *come.fill]
        placed = placement.place(waiting, every, busy, cuda=self._cuda)
        idle = not placed and not running
        self._journal.explain(self._why(growth, waits=bool(tasks)) if idle else "")
        return placed

    @property
    def idle(self) -> float | None:
        """Seconds after which a machine without a task goes; None if all stay."""
        return IDLE_S if self._pool.growth().groups else None

    @property
    def expecting(self) -> bool:
        """Whether machines have been requested that are not there yet, or one is needed."""
        return bool(self._expected.since or self._journal.why)

    def _grow(self, growth: Growth, work: Work, running: Sequence[Running], nodes: Sequence[Node]) -> Coming:
        """Requests what a stage should have besides, and returns what is coming."""
        budget = self._journal.state.money.budget
        price, settings = price_by(prices_of(budget)), self._config.scaling
        found = self._expected.decide(growth, work, running, nodes, settings, price, cuda=self._cuda)
        if found.more:
            names, stage = _named(growth, found.more, "more of"), work.demands[0].task.stage
            self._journal.record([Noticed(None, f"requested from Ray's autoscaler for {stage}: {names}")])
        self._pool.request(found.wanted)
        return found

    def _why(self, growth: Growth, *, waits: bool) -> str:
        """Why nothing can start. Args: waits, whether there is a task that could."""
        state, what = self._journal.state, "GPU" if self._cuda else "core"
        if not waits:
            return _paused(state.held_blocks())
        able = placement.able(self._pool.nodes(), cuda=self._cuda)
        if not growth.groups and not able:
            return f"waiting for a machine with a {what}: the cluster has none now"
        staying = leaving.staying(state, able)
        if shut := quarantine.waiting(state, staying):
            return f"waiting: {shut}"
        if not growth.groups:
            return "" if staying else f"waiting for a machine with a {what}: all that are there leave"
        since = self._expected.since
        if not since:
            why = f"waiting for a machine with a {what}: Ray's autoscaler has started all that it may"
            return why + growth.report
        first = min(times[0] for times in since.values())
        when = f"{datetime.fromtimestamp(first).astimezone():%H:%M:%S}"
        names = _named(growth, {name: len(times) for name, times in since.items()}, "of")
        return f"waiting for machines: {names}, requested from Ray's autoscaler at {when}{growth.report}"

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


def _named(growth: Growth, counts: Mapping[str, int], of: str) -> str:
    """The counts of machines of each group, for people."""
    texts = {group.name: group.text() for group in growth.groups}
    return ", ".join(f"{count} {of} {texts[name]}" for name, count in counts.items())


def _paused(blocks: Sequence[int]) -> str:
    """The line that says that a run waits for blocks which a user has paused; "" if there are none."""
    if len(blocks) < 2:
        return "".join(f"waiting: block {block} is paused" for block in blocks)
    named = ", ".join(map(str, blocks)) if len(blocks) <= _NAMED else f"{blocks[0]} to {blocks[-1]}"
    return f"waiting: {len(blocks)} blocks are paused ({named})"
