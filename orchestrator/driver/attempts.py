"""Attempts at tasks that a pool runs now."""

from dataclasses import dataclass

from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.resources.pool import Hello
from panolog.orchestrator.run.records import TaskStarted
from panolog.workers.evaluation import EvaluateSpec
from panolog.workers.scoring import ScoreSpec
from panolog.workers.training.trainer import TrainSpec

WorkerSpec = TrainSpec | ScoreSpec | EvaluateSpec


@dataclass
class Attempt:
    """One at a task that the pool has."""

    spec: WorkerSpec
    number: int  # 1 for the first
    iteration: int  # of the checkpoint that it continues from
    placement: Placement
    latest: float  # Clock.monotonic() of its start, then of its last message; later by what does not count
    ready: bool = False  # it has sent Hello, and can be requested to stop
    stopping: bool = False  # it is requested to save a checkpoint and end

    def started(self, hello: Hello) -> TaskStarted:
        """The record of its Hello."""
        spec = self.spec
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
        )
