"""An attempt at a task, as its driver remembers it while it lasts."""

from dataclasses import dataclass

from panolog.orchestrator.resources.messages import Hello
from panolog.orchestrator.resources.nodes import Place
from panolog.orchestrator.run.config import RunConfig
from panolog.orchestrator.run.records import TaskStarted


@dataclass
class Attempt:
    """One that the pool has."""

    name: str  # of the task
    number: int  # 1 for the first
    iteration: int  # it goes on from here
    place: Place
    config: RunConfig | None
    greeted: bool = False  # it has said Hello, and can be asked something
    asked: bool = False  # to save a checkpoint and end

    def started(self, hello: Hello, device: str) -> TaskStarted:
        """Takes note of its greeting and returns the record of it."""
        self.greeted = True
        return TaskStarted(
            self.name,
            self.number,
            self.iteration,
            hello.node,
            hello.pid,
            device,
            self.place.threads,
            self.place.kind,
            self.config.cache.memory if self.config else None,
        )
