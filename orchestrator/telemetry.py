"""What Prometheus and the dashboards of Ray hear of a run: its progress as metrics of `ray.util.metrics`.

Only the driver exports, from the records that it writes: workers know nothing of it, and no number is told
in two ways. Ray puts "ray_" before the names. A gauge that is NaN is no longer exported, and so a task leaves
the place where it no longer runs.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ray.util.metrics import Counter, Gauge

from panolog.orchestrator.records import (
    EvaluationSaved,
    ModelSaved,
    Progressed,
    Record,
    ScoresSaved,
    Stored,
    TaskFailed,
    Transferred,
)
from panolog.orchestrator.state import RunState

GAUGES = {
    "panolog_iteration": "Iterations that a task has done.",
    "panolog_iterations": "Iterations of a task in all.",
    "panolog_iterations_per_second": "Recent speed of a task.",
    "panolog_loss": "Training loss, mean since the last report.",
    "panolog_psnr_db": "PSNR over the training views, mean since the last report.",
    "panolog_gaussians": "Gaussians of a task.",
    "panolog_memory_bytes": "Memory in use: of the device on CUDA, of the process on the CPU.",
}
COUNTERS = {
    "panolog_retries_total": "Attempts that failed and are repeated.",
    "panolog_moved_bytes_total": "Bytes that a task has sent to or received from other machines.",
}
TAGS = ("run", "task", "node")
_WHILE_RUNNING = ("panolog_iterations_per_second", "panolog_memory_bytes")


@dataclass(frozen=True)
class Sample:
    """A new value of a gauge, or what is added to a counter."""

    metric: str
    task: str
    node: str
    value: float


def samples(state: RunState, record: Record) -> Iterator[Sample]:
    """What a record says in metrics; `state` is after it."""
    values: dict[str, float | None] = {}
    match record:
        case Progressed():
            values = {
                "panolog_iteration": record.iteration,
                "panolog_iterations": record.iterations,
                "panolog_iterations_per_second": record.rate,
                "panolog_loss": record.loss,
                "panolog_psnr_db": record.psnr,
                "panolog_gaussians": record.gaussians,
                "panolog_memory_bytes": record.memory,
            }
        case ModelSaved():
            values = {"panolog_iteration": record.iterations, "panolog_gaussians": record.gaussians}
            values |= dict.fromkeys(_WHILE_RUNNING, math.nan)
        case ScoresSaved() | EvaluationSaved():
            values = dict.fromkeys(_WHILE_RUNNING, math.nan)
        case TaskFailed():
            values = dict.fromkeys(GAUGES, math.nan)
            values |= {} if record.final else {"panolog_retries_total": 1}
        case Transferred():
            values = {"panolog_moved_bytes_total": record.received + record.sent}
    node = state.task(record.task).node
    for metric, value in values.items():
        if value is not None:
            yield Sample(metric, record.task, node, value)


class Telemetry:
    """Exports the metrics of one run. Needs Ray to be initialised."""

    def __init__(self, run: Path) -> None:
        self._run = str(run.absolute())
        self._gauges = {name: Gauge(name, text, TAGS) for name, text in GAUGES.items()}
        self._counters = {name: Counter(name, text, TAGS) for name, text in COUNTERS.items()}

    def show(self, state: RunState, news: Sequence[Stored]) -> None:
        """Hears of every change, as a display does."""
        for stored in news:
            for sample in samples(state, stored.record):
                self._export(sample)

    def _export(self, sample: Sample) -> None:
        values = (self._run, sample.task, sample.node)
        tags = {tag: _ascii(value) for tag, value in zip(TAGS, values, strict=True)}
        if sample.metric in self._gauges:
            self._gauges[sample.metric].set(sample.value, tags)
        elif sample.value > 0:  # a counter of Ray refuses to add nothing
            self._counters[sample.metric].inc(sample.value, tags)


def _ascii(text: str) -> str:
    """Ray refuses a tag with other letters."""
    return text.encode("ascii", "backslashreplace").decode()
