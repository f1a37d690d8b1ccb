"""Attempts at tasks that a pool runs now."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

from panolog.orchestrator.engine.driver import policy
from panolog.orchestrator.engine.scheduling import placement, quarantine
from panolog.orchestrator.engine.scheduling.pool import Failed, Hello
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.machines.history import leave_of
from panolog.orchestrator.runs.machines.nodes import Node, Placement
from panolog.orchestrator.runs.records import Failure, TaskFailed, TaskStarted
from panolog.orchestrator.runs.state import RunState
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.scoring import ScoreSpec
from panolog.workers.training.trainer import TrainSpec

_LOG = logging.getLogger(__name__)
WorkerSpec = TrainSpec | ScoreSpec | EvaluateSpec


@dataclass
class Attempt:
    """An attempt at a task that the pool has."""

    spec: WorkerSpec
    number: int  # 1 for the first
    iteration: int  # of the checkpoint that it continues from
    placement: Placement
    latest: float  # Clock.monotonic() of its start, then of its last message; later by what does not count
    ready: bool = False  # it has sent Hello, and can be requested to stop
    stopping: bool = False  # it is requested to save a checkpoint and end

    def started(self, hello: Hello, nodes: Sequence[Node]) -> TaskStarted:
        """The record of its Hello, after which it can be requested to stop. Args: nodes, those there are."""
        self.ready, spec = True, self.spec
        if hello.card:
            gpus = next((node.gpus for node in nodes if node.id == self.placement.node), ())
            for gpu in (number for number, card in enumerate(gpus) if card.uuid == hello.card):
                self.placement = replace(self.placement, gpu=gpu, uuid=hello.card)
        return TaskStarted(
            spec.task,
            self.number,
            self.iteration,
            hello.node,
            hello.pid,
            spec.device,
            self.placement.threads,
            self.placement.kind,
            None if isinstance(spec, EvaluateSpec) else spec.config.cache.memory,
            self.placement.node,
            self.placement.card,
        )

    def failed(
        self, message: Failed, state: RunState, nodes: Sequence[Node], config: RunConfig
    ) -> TaskFailed:
        """The record of its failure, with what follows from it. Args: nodes, those that can run tasks."""
        task, where, kind = self.spec.task, self.placement, message.kind
        preempted = kind == Failure.LOST and leave_of(state.nodes, where.node) is not None
        then = policy.after_failure(
            state.task(task),
            kind,
            node=where.node,
            others=any(node.id != where.node for node in quarantine.usable(state, nodes)),
            retries=config.retries,
            preemptions=config.preemptions if preempted else None,
            memory=where.memory,
            largest=placement.largest(nodes, cuda=config.device == "cuda"),
        )
        excused = quarantine.excuses(state, (where.node, where.card), kind)
        final = then.final and not excused
        _LOG.info("%s: attempt %d failed (%s): %s", task, self.number, kind, message.reason)
        _LOG.info("%s: %s", task, "no more attempts" if final else then.then or "will be retried")
        return TaskFailed(
            task,
            self.number,
            message.reason,
            final,
            message.detail,
            kind,
            where.memory,
            then.then,
            where.node,
            excused,
            preempted,
            where.card,
        )
