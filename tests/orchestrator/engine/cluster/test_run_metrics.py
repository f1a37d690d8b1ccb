"""What Prometheus receives about a run. That a real Ray exports it is in test_cluster.py."""

from pathlib import Path

import pytest

from panolog.orchestrator.engine.cluster import run_metrics
from panolog.orchestrator.engine.cluster.run_metrics import COUNTERS, GAUGES, TAGS, RunMetrics, counts, gauges
from panolog.orchestrator.runs.records import (
    ModelSaved,
    Noticed,
    Progressed,
    Record,
    Stored,
    TaskFailed,
    TaskStarted,
    Transferred,
)
from panolog.orchestrator.runs.state import RunState, apply
from panolog.workers.tasks import TaskId

BLOCK = TaskId.block(0)
WHILE_RUNNING = {"panolog_iterations_per_second", "panolog_memory_bytes"}
STARTED = TaskStarted(BLOCK, 1, 0, "Nürnberg", 1, "cpu", 1)
PROGRESS = Progressed(BLOCK, 5, 10, 2.5, loss=0.25, psnr=20.0, gaussians=7, memory=2**20)


def after(*records: Record) -> tuple[RunState, list[Stored]]:
    state, stored = RunState(), [Stored(i, float(i), record) for i, record in enumerate(records, 1)]
    for one in stored:
        state = apply(state, [one])
    return state, stored


def standing(*records: Record) -> dict[str, float]:
    found = list(gauges(after(*records)[0]))
    assert {(sample.task, sample.node) for sample in found} <= {(str(BLOCK), "Nürnberg")}
    return {sample.metric: sample.value for sample in found}


def test_progress_is_every_gauge_that_is_known_and_speed_and_memory_are_those_of_a_worker() -> None:
    values = standing(STARTED, PROGRESS)
    assert set(values) == set(GAUGES)
    assert (values["panolog_iteration"], values["panolog_memory_bytes"]) == (5, 2**20)
    known = standing(STARTED, Progressed(BLOCK, 5, 10, 2.5))
    assert set(known) == {"panolog_iteration", "panolog_iterations", "panolog_iterations_per_second"}
    assert standing(STARTED) == {}
    for end in (ModelSaved(BLOCK, "model.ply", 9, 100, 10, 4.0), TaskFailed(BLOCK, 1, "died", final=False)):
        assert set(standing(STARTED, PROGRESS, end)) == set(GAUGES) - WHILE_RUNNING


@pytest.mark.parametrize(
    ("record", "added"),
    [
        (TaskFailed(BLOCK, 1, "died", final=False), [("panolog_retries_total", 1)]),
        (TaskFailed(BLOCK, 3, "died", final=True), []),
        (Transferred(BLOCK, 2, 3), [("panolog_moved_bytes_total", 5)]),
        (Transferred(BLOCK, 0, 0), []),
        (Noticed(BLOCK, "a.jpg is left out"), []),
    ],
)
def test_retries_and_bytes_are_counted(record: Record, added: list[tuple[str, float]]) -> None:
    state, _ = after(STARTED, record)
    assert [(sample.metric, sample.value) for sample in counts(state, record)] == added


class Fake:
    """A gauge or counter that remembers, and is as strict as Ray's."""

    def __init__(self, name: str, description: str, tag_keys: tuple[str, ...]) -> None:
        assert description and tag_keys == TAGS
        self.calls: list[tuple[tuple[str, ...], float]] = []

    def set(self, value: float, tags: dict[str, str]) -> None:
        assert value > 0 and all(tag.isascii() for tag in tags.values())
        self.calls.append((tuple(tags[key] for key in TAGS), value))

    inc = set


def test_gauges_are_set_again_and_counters_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: dict[str, Fake] = {}

    def make(name: str, description: str, tag_keys: tuple[str, ...]) -> Fake:
        return made.setdefault(name, Fake(name, description, tag_keys))

    monkeypatch.setattr(run_metrics, "Gauge", make)
    monkeypatch.setattr(run_metrics, "Counter", make)
    clock = iter((0.0, 1.0, 5.0, 6.0, 20.0))
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    exporter = RunMetrics(Path("/runs/日"))
    assert set(made) == set(GAUGES) | set(COUNTERS)
    state, news = after(STARTED, PROGRESS, Transferred(BLOCK, 2, 3))
    exporter.show(state, news)
    tags = ("/runs/\\u65e5", str(BLOCK), "N\\xfcrnberg")
    for _ in range(4):
        exporter.show(state, [])
    assert made["panolog_loss"].calls == [(tags, 0.25)] * 3
    assert made["panolog_moved_bytes_total"].calls == [(tags, 5)]
    assert made["panolog_retries_total"].calls == []
