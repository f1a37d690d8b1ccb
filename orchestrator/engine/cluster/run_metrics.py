"""The state of a run for Prometheus and the dashboards of Ray: as metrics of `ray.util.metrics`.

Only the driver exports, from the state that it has anyway. Ray puts "ray_" before the names. It forgets a
gauge that is not set again for some seconds, so all are set every few.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ray.util.metrics import Counter, Gauge

from panolog.orchestrator.runs.records import Record, Stored, TaskFailed, Transferred
from panolog.orchestrator.runs.state import OnChange, RunState, Status, ignore

GAUGES = {  # by name, the field of `Progressed` and what it is
    "panolog_iteration": ("iteration", "Iterations that a task has done."),
    "panolog_iterations": ("iterations", "Iterations of a task in all."),
    "panolog_iterations_per_second": ("rate", "Recent speed of a task that runs."),
    "panolog_loss": ("loss", "Training loss, mean since the last report."),
    "panolog_psnr_db": ("psnr", "PSNR over the training views, mean since the last report."),
    "panolog_gaussians": ("gaussians", "Gaussians of a task."),
    "panolog_memory_bytes": (
        "memory",
        "Memory of a task that runs: of the device on CUDA, of the process on the CPU.",
    ),
}
_OF_WORKERS = ("rate", "memory")  # fields of no interest once a task does not run
COUNTERS = {
    "panolog_retries_total": "Attempts that failed and are repeated.",
    "panolog_moved_bytes_total": "Bytes that a task has sent to or received from other machines.",
}
TAGS = ("run", "task", "node")
_INTERVAL = (
    5.0  # seconds between two exports of all gauges; Ray reports every ten and forgets after twice that
)


@dataclass(frozen=True)
class MetricSample:
    """A value of a gauge, or what is added to a counter."""

    metric: str
    task: str
    node: str
    value: float


def gauges(state: RunState) -> Iterator[MetricSample]:
    """Where every task stands that has reported something."""
    for task in state.tasks.values():
        for metric, (name, _) in GAUGES.items():
            value = getattr(task.progress, name, None)
            if value is not None and (task.status == Status.RUNNING or name not in _OF_WORKERS):
                yield MetricSample(metric, str(task.id), task.node, value)


def counts(state: RunState, record: Record) -> Iterator[MetricSample]:
    """What a record adds to the counters; `state` is after it."""
    match record:
        case TaskFailed(final=False):
            metric, value = "panolog_retries_total", 1
        case Transferred():
            metric, value = "panolog_moved_bytes_total", record.received + record.sent
        case _:
            return
    if value:  # Ray refuses to add nothing
        yield MetricSample(metric, str(record.task), state.task(record.task).node, value)


class RunMetrics:
    """Exports the metrics of one run. Needs Ray to be initialised."""

    def __init__(self, run: Path, on_change: OnChange = ignore) -> None:
        """Args: on_change, called after each state that is shown."""
        self._on_change = on_change
        self._run = str(run.absolute())
        self._gauges = {name: Gauge(name, text, TAGS) for name, (_, text) in GAUGES.items()}
        self._counters = {name: Counter(name, text, TAGS) for name, text in COUNTERS.items()}
        self._exported = -_INTERVAL

    def show(self, state: RunState, news: Sequence[Stored]) -> None:
        """Exports a state: called with every change, and often without one."""
        for stored in news:
            for sample in counts(state, stored.record):
                self._counters[sample.metric].inc(sample.value, self._tags(sample))
        now = time.monotonic()
        if now - self._exported >= _INTERVAL:
            self._exported = now
            for sample in gauges(state):
                self._gauges[sample.metric].set(sample.value, self._tags(sample))
        self._on_change(state, news)

    def _tags(self, sample: MetricSample) -> dict[str, str]:
        values = (self._run, sample.task, sample.node)
        return {t: v.encode("ascii", "backslashreplace").decode() for t, v in zip(TAGS, values, strict=True)}
