"""What the follower needs of a sink. A sink has one run for each run of ours, also over several followers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from panolog.orchestrator.runs.records import Outcome

Value = str | int | float | bool


@dataclass(frozen=True)
class Point:
    """One value of a curve."""

    name: str  # of the curve: loss, psnr, …
    iteration: int
    time: float  # seconds since the epoch
    value: float


@dataclass(frozen=True)
class Facts:
    """What a sink knows of a run from its begin."""

    id: str  # `notifications.run_id`
    name: str  # of the run folder
    settings: Mapping[str, Value]  # all, by their names such as "sky.count"


class Sink(ABC):
    """One sink, used by one thread. All but `errors` reaches out, and raises one of those if that fails."""

    errors: ClassVar[tuple[type[Exception], ...]] = (OSError,)  # after which trying again may help

    @abstractmethod
    def open(self, facts: Facts, known: str) -> str:
        """Takes up the run there, or makes it. Args: known, what this returned before, "" = nothing."""

    @abstractmethod
    def present(self, task: str, after: int, until: int, names: Sequence[str]) -> set[tuple[str, int]]:
        """The points (name, iteration) of a task in (after, until] that the sink has."""

    @abstractmethod
    def log(self, task: str, points: Sequence[Point]) -> None:
        """Adds points; the sink has them when it returns."""

    @abstractmethod
    def finish(self, outcome: Outcome | None, metrics: Mapping[str, float], report: Path | None) -> None:
        """The driver has ended. Args: outcome, None if it was killed; metrics, of the merged model."""
