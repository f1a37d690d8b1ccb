"""A run's state with what pages show beyond it: when stages began and ended, and where tasks run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.records import (
    PreflightSaved,
    Preparing,
    Progressed,
    Result,
    Stored,
    TaskFailed,
    TaskStarted,
    task_name,
)
from panolog.orchestrator.runs.state import RunState, apply, replay
from panolog.workers.tasks import AFTER_TRAINING, Stage, TaskId


@dataclass(frozen=True)
class Span:
    """When a stage began and when its last task ended, in seconds since the epoch."""

    began: float
    ended: float | None = None


@dataclass
class History:
    """A run up to the last record that was read."""

    state: RunState = field(default_factory=RunState)
    spans: dict[Stage, Span] = field(default_factory=dict)
    starts: dict[TaskId, TaskStarted] = field(default_factory=dict)  # the latest of each task
    last: int = 0  # id of the last record
    limited: float | None = None  # when a limit has ended the training early, in seconds since the epoch

    @staticmethod
    def of(records: Iterable[Stored]) -> "History":
        """From the records that `store.read_milestones` returns."""
        stored = list(records)
        history = History(replay(stored), last=stored[-1].id if stored else 0)
        for item in stored:
            history._note(item)
        return history

    def add(self, records: Iterable[Stored]) -> set[str]:
        """Adds later records, in order. Returns the tasks that they are about."""
        stored = list(records)
        self.state = apply(self.state, without_older_progress(stored))
        for item in stored:
            self._note(item)
            self.last = item.id
        return {task_name(item.record) for item in stored}

    def _note(self, stored: Stored) -> None:
        record = stored.record
        if isinstance(record, TaskStarted):
            self.starts[record.task] = record
            self.spans.setdefault(record.task.stage, Span(stored.time))
        elif isinstance(record, Preparing):
            if self.spans.keys() <= {Stage.PREPARE}:  # else it is a new driver of a run that is past it
                self._note_preparing(record.task.stage, stored.time)
        elif isinstance(record, PreflightSaved | Result) or (isinstance(record, TaskFailed) and record.final):
            span = self.spans.get(record.task.stage) or Span(self._latest_end() or stored.time)
            self.spans[record.task.stage] = replace(span, ended=stored.time)
        elif isinstance(record, BudgetReached):
            self.limited = stored.time
        elif isinstance(record, BudgetSet) and self.limited is not None:  # all that followed is made anew
            self.limited = None
            for stage in AFTER_TRAINING:
                self.spans.pop(stage, None)

    def _note_preparing(self, stage: Stage, time: float) -> None:
        """The scene is being made, or the preflight begins."""
        if stage is not Stage.PREPARE and (made := self.spans.get(Stage.PREPARE)):
            self.spans[Stage.PREPARE] = replace(made, ended=time)
        self.spans.setdefault(stage, Span(time))

    def _latest_end(self) -> float | None:
        """When the latest stage ended: plan and merge have no start record, they begin with that."""
        ends = (self.limited, *(span.ended for span in self.spans.values()))
        return max((end for end in ends if end is not None), default=None)

    def cut(self, stage: Stage) -> float | None:
        """When a limit has ended a stage early; None of one that it has not, or that follows."""
        span = self.spans.get(stage)
        return None if span is None or stage in AFTER_TRAINING else self.limited


def without_older_progress(records: Sequence[Stored]) -> list[Stored]:
    """Records, of progress only the latest of each task."""
    latest = {stored.record.task: stored.id for stored in records if isinstance(stored.record, Progressed)}
    return [s for s in records if not isinstance(s.record, Progressed) or latest[s.record.task] == s.id]
