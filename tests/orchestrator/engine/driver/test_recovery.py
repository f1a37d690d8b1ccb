"""Where tasks start, what a run does about lack of memory, deaths and Ctrl-C, and how it ends."""

import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.engine.driver import driver as driver_module
from panolog.orchestrator.engine.driver import saving, writers
from panolog.orchestrator.engine.scheduling.pool import Failed
from panolog.orchestrator.runs.database import Database, read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from panolog.orchestrator.runs.records import (
    Failure,
    Outcome,
    Record,
    RunEnded,
    StopRequested,
    TaskFailed,
    TaskStarted,
)
from panolog.scene.errors import ClusterLostError, InputError, RunError, RunLockedError
from panolog.workers.events import Calibration, Checkpoint, Event, Trained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, Progress, TaskId
from panolog.workers.training.checkpoint import CheckpointFile
from panolog.workers.training.task_config import CacheConfig
from tests.orchestrator.fakes import LOST_NODE, CrashError, Harness, Script, SetClock, begins, well
from tests.orchestrator.history import AGAIN

GIB = 2**30
NO_MEMORY = Failed("out of memory: CUDA out of memory. Tried to allocate 2.00 GiB", Failure.MEMORY)


def with_gpu(name: str, gib: int, count: int = 1) -> Node:
    """A node with GPUs; 0 GiB means that their memory is unknown, and no tasks share them."""
    return Node(
        name, f"host-{name}", cpus=4, memory=2**40, gpus=(Gpu(f"{gib} GiB", gib * GIB, name),) * count
    )


# Where and when tasks start


def test_the_order_of_blocks_follows_what_was_measured(tmp_path: Path) -> None:
    """The fewer Gaussians a block has, the longer it takes here: after a few of them the driver knows."""
    harness = Harness(tmp_path, [with_gpu("a", 0)], device="cuda", blocks="2x2x2")
    blocks: dict[TaskId, int] = {}

    def script(spec: TaskSpec) -> Iterator[Event]:
        blocks.update({TaskId.block(b.block): b.gaussians for b in harness.state.plan or ()})
        for event in well(spec):
            if isinstance(event, Trained) and spec.task in blocks:
                event = replace(event, seconds=math.exp(40 - blocks[spec.task]))  # noqa: PLW2901
            yield event

    assert harness.drive(script).outcome == "done"
    order = [blocks[task] for task in harness.tasks if task in blocks]
    assert order[0] == max(order)
    assert order[4:] == sorted(order[4:])


# Deaths


def test_the_death_of_a_machine_does_not_use_up_retries(tmp_path: Path) -> None:
    nodes = [with_gpu("a", 24), with_gpu("b", 24)]
    harness = Harness(tmp_path, nodes, device="cuda", retries=0)
    saved = Checkpoint(COARSE, 1, {"iteration": torch.tensor(1)})
    lost = begins(COARSE, saved, lambda: harness.pool.lose(harness.pool.placement(COARSE).node))
    assert harness.drive(lost).outcome == "done"
    assert [place.node for place, _ in harness.attempts(COARSE)] == ["a", "b"]
    first, second = harness.trainings(COARSE)
    assert (first.checkpoint, second.checkpoint) == (None, CheckpointFile(harness.folder.checkpoint(COARSE)))
    assert [(s.attempt, s.iteration) for s in harness.records(TaskStarted)][:2] == [(1, 0), (2, 1)]
    task = harness.state.task(COARSE)
    assert (task.retries, task.reasons, task.losses) == (1, (LOST_NODE.reason,), 1)  # not pre-empted


# Memory


def test_a_block_that_runs_out_of_memory_gets_less_cache_then_a_larger_gpu(tmp_path: Path) -> None:
    nodes = [with_gpu("a", 8), with_gpu("b", 24)]
    harness = Harness(tmp_path, nodes, device="cuda")

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task == TaskId.block(0) and (
            len(harness.attempts(spec.task)) == 1 or harness.pool.placement(spec.task).node == "a"
        ):
            raise CrashError(NO_MEMORY)
        yield from well(spec)

    assert harness.drive(script).outcome == "done"
    attempts = harness.attempts(TaskId.block(0))
    caches = [spec.config.cache.memory for spec in harness.trainings(TaskId.block(0))]
    assert caches[0] > CacheConfig().memory  # as its machine allows
    assert caches[1:] == [CacheConfig().memory / 4] * (len(attempts) - 1)
    assert [place.gpus for place, _ in attempts[1:]] == [1.0] * (len(attempts) - 1)
    assert attempts[-1][0].node == "b"
    assert [s.cache for s in harness.records(TaskStarted) if s.task == TaskId.block(0)] == caches
    why = "tried again with a smaller image cache and nothing else on its device"
    assert harness.state.task(TaskId.block(0)).reasons[0] == f"{NO_MEMORY.reason}; {why}"


# Ctrl-C


def stops_in(task: TaskId, harness: Harness, *, obeys: bool = True) -> Script:
    """Ctrl-C while a task trains; tasks that are requested to stop yield a checkpoint and end."""

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task.stage is not task.stage:
            yield from well(spec)
            return
        for iteration in range(2, 100):
            yield Progress(spec.task, iteration, 100, 1.0, gaussians=1000)
            if spec.task == task and iteration == 5:
                harness.stop.signal()
            if obeys and spec.task in harness.pool.stopped:
                yield Checkpoint(spec.task, iteration, {"iteration": torch.tensor(iteration)})
                return

    return script


def test_ctrl_c_waits_for_fresh_checkpoints(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """For as long as they take at the rate that was measured before, not for a fixed time."""
    harness.clock = clock = SetClock()
    monkeypatch.setattr(writers, "GRACE_S", 0.0)

    def slow(folder: RunFolder, event: Event, *rest: Any) -> Record:
        clock.sleep(1.0)
        return saving.save(folder, event, *rest)

    monkeypatch.setattr(driver_module, "save", slow)
    with pytest.raises(KeyboardInterrupt):
        harness.drive(stops_in(TaskId.block(0), harness))
    assert harness.pool.stopped == {TaskId.block(0), TaskId.block(1)}
    assert harness.records(StopRequested) == [StopRequested(2)]
    assert harness.records(RunEnded) == [RunEnded(Outcome.INTERRUPTED)]
    assert not harness.records(TaskFailed)
    state = harness.state
    fresh = {task: state.task(task).checkpoint for task in harness.pool.stopped}
    assert fresh == {task: state.task(task).progress.iteration for task in fresh}  # type: ignore[union-attr]
    assert harness.drive(resumed=True).outcome == "done"
    began = {s.task: s.iteration for s in harness.records(TaskStarted)[-3:]}
    assert began == fresh | {EVAL: 0}


@pytest.mark.parametrize("again", [True, False], ids=["second Ctrl-C", "its time is over"])
def test_who_does_not_obey_is_not_waited_for(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, again: bool
) -> None:
    if not again:
        monkeypatch.setattr(writers, "GRACE_S", 0.0)

    def script(spec: TaskSpec) -> Iterator[Event | Calibration]:
        for event in stops_in(COARSE, harness, obeys=False)(spec):
            yield event
            if again and harness.pool.stopped:
                harness.stop.signal()

    with pytest.raises(KeyboardInterrupt):
        harness.drive(script)
    assert harness.records(RunEnded) == [RunEnded(Outcome.INTERRUPTED)]
    assert harness.state.task(COARSE).checkpoint is None


def test_ctrl_c_where_nothing_trains_ends_at_once(harness: Harness) -> None:
    with pytest.raises(KeyboardInterrupt):
        harness.drive(begins(EVAL, lambda: harness.stop.signal()))  # noqa: PLW0108  # drive makes a new one
    assert harness.records(StopRequested) == [StopRequested(0)]
    assert harness.pool.stopped == set()


# However a driver ends, the run's history has its end and why


@pytest.mark.parametrize(
    ("error", "raised", "reason", "transient"),
    [
        (ValueError("bad"), ValueError, "internal error: ValueError: bad", True),
        (SystemExit(3), SystemExit, "internal error: SystemExit: 3", True),
        (ClusterLostError("Ray: no head"), ClusterLostError, "Ray: no head", True),
        (OSError("EIO"), RunError, "EIO", True),
        (sqlite3.OperationalError("locked"), RunError, "locked", True),
        (InputError("a.jpg is truncated"), InputError, "a.jpg is truncated", False),
    ],
    ids=str,
)
def test_an_error_of_the_pool_leaves_its_record(
    harness: Harness, error: BaseException, raised: type[BaseException], reason: str, transient: bool
) -> None:
    with pytest.raises(raised):
        harness.drive(begins(COARSE, Progress(COARSE, 1, 2, 3.0), error))
    (ended,) = harness.records(RunEnded)
    assert (ended.outcome, ended.reason, ended.transient) == (Outcome.FAILED, reason, transient)
    assert ("fakes.py" in ended.detail) == reason.startswith("internal error")
    assert harness.state.transient == transient
    assert harness.drive(resumed=True).outcome == "done"
    assert not harness.state.transient


def test_a_driver_whose_run_another_has_taken_over_ends_without_a_record(harness: Harness) -> None:
    """Where locks do not work."""

    def take_over() -> None:
        with closing(Database(harness.folder.database)) as database:
            database.append([AGAIN])

    steps = Progress(COARSE, 1, 2, 3.0), take_over, Progress(COARSE, 2, 2, 3.0)
    with pytest.raises(RunLockedError, match="another driver has taken the run over"):
        harness.drive(begins(COARSE, *steps))
    *_, last = read_records(harness.folder.database)
    assert last.record == AGAIN
    assert harness.drive(resumed=True).outcome == "done"
