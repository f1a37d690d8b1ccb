"""What Prometheus hears of a run. That a real Ray exports it is in test_cluster.py."""

import math
from pathlib import Path

import pytest

from panolog.orchestrator import telemetry
from panolog.orchestrator.records import (
    ModelSaved,
    Noticed,
    Progressed,
    Record,
    Stored,
    TaskFailed,
    TaskStarted,
    Transferred,
)
from panolog.orchestrator.state import RunState, apply
from panolog.orchestrator.telemetry import COUNTERS, GAUGES, TAGS, Telemetry, samples

BLOCK = "block/000"
STARTED = TaskStarted(BLOCK, 1, 0, "Nürnberg", 1, "cpu", 1)
PROGRESS = Progressed(BLOCK, 5, 10, 2.5, loss=0.25, psnr=20.0, gaussians=7, memory=2**20)


def after(*records: Record) -> tuple[RunState, list[Stored]]:
    state, stored = RunState(), [Stored(i, float(i), record) for i, record in enumerate(records, 1)]
    for one in stored:
        state = apply(state, one)
    return state, stored


def told(*records: Record) -> dict[str, float]:
    """The samples of the last record."""
    state, _ = after(*records)
    found = list(samples(state, records[-1]))
    assert {(sample.task, sample.node) for sample in found} <= {(BLOCK, "Nürnberg")}
    return {sample.metric: sample.value for sample in found}


def test_progress_is_every_gauge_that_is_known() -> None:
    values = told(STARTED, PROGRESS)
    assert set(values) == set(GAUGES)
    assert (values["panolog_iteration"], values["panolog_memory_bytes"]) == (5, 2**20)
    known = told(STARTED, Progressed(BLOCK, 5, 10, 2.5))
    assert set(known) == {"panolog_iteration", "panolog_iterations", "panolog_iterations_per_second"}


def test_a_task_that_has_ended_keeps_its_result_and_gives_up_its_place() -> None:
    values = told(STARTED, PROGRESS, ModelSaved(BLOCK, "model.ply", 9, 100, 10, 4.0))
    assert (values["panolog_iteration"], values["panolog_gaussians"]) == (10, 9)
    assert math.isnan(values["panolog_memory_bytes"])
    assert math.isnan(values["panolog_iterations_per_second"])


def test_a_failed_attempt_leaves_its_node_and_counts_if_it_is_repeated() -> None:
    again = told(STARTED, PROGRESS, TaskFailed(BLOCK, 1, "died", final=False))
    assert again.pop("panolog_retries_total") == 1
    assert set(again) == set(GAUGES)
    assert all(map(math.isnan, again.values()))
    assert set(told(STARTED, PROGRESS, TaskFailed(BLOCK, 3, "died", final=True))) == set(GAUGES)


def test_other_records_say_nothing() -> None:
    assert told(STARTED) == {}
    assert told(STARTED, Noticed(BLOCK, "a.jpg is left out")) == {}


class Fake:
    """A gauge or counter that remembers, and is as strict as Ray's."""

    def __init__(self, name: str, description: str, tag_keys: tuple[str, ...]) -> None:
        assert description
        assert tag_keys == TAGS
        self.values: dict[tuple[str, ...], float] = {}

    def set(self, value: float, tags: dict[str, str]) -> None:
        assert all(tag.isascii() for tag in tags.values())
        self.values[tuple(tags[key] for key in TAGS)] = value

    def inc(self, value: float, tags: dict[str, str]) -> None:
        assert value > 0
        self.set(value, tags)


def test_tags_and_counters_are_such_as_ray_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    made: dict[str, Fake] = {}

    def make(name: str, description: str, tag_keys: tuple[str, ...]) -> Fake:
        return made.setdefault(name, Fake(name, description, tag_keys))

    monkeypatch.setattr(telemetry, "Gauge", make)
    monkeypatch.setattr(telemetry, "Counter", make)
    Telemetry(Path("/runs/日")).show(
        *after(STARTED, PROGRESS, Transferred(BLOCK, 0, 0), Transferred(BLOCK, 2, 3))
    )
    assert set(made) == set(GAUGES) | set(COUNTERS)
    tags = ("/runs/\\u65e5", BLOCK, "N\\xfcrnberg")
    assert made["panolog_loss"].values == {tags: 0.25}
    assert made["panolog_moved_bytes_total"].values == {tags: 5}
    assert made["panolog_retries_total"].values == {}
