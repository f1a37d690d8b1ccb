"""Runs with a real Ray that are disturbed: by the requests of the control channel, by a lack of memory."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.pool import RayPool
from panolog.orchestrator.driver.attempts import WorkerSpec
from panolog.orchestrator.driver.driver import Driver, Hooks
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.control import Action
from panolog.orchestrator.run.records import Failure, RunBegan, Stored, TaskFailed, TaskStarted, TaskYielded
from panolog.orchestrator.run.state import RunState, Status
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError
from panolog.scene.ply import read_ply
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

ZERO, ONE = TaskId.block(0), TaskId.block(1)
SMALL: dict[str, Any] = {"sky": {"count": 20}, "partition": {"min_cameras": 1}}  # blocks have one or two
SETTINGS: dict[str, Any] = {**SMALL, "iterations": 360, "retries": 1}  # requests come before a block's end
Wish = Callable[[RunState], tuple[str, int | None] | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class Broken(TrainSpec):
    """Fails at once."""

    def run(self) -> Iterator[Event]:
        raise RuntimeError("broken")


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayPool]:
    with connect(None, tmp_path_factory.mktemp("ray")) as pool:
        yield pool


def drive(
    harness: Harness, pool: RayPool, wish: Wish, *, failures: int = 0, resumed: bool = False
) -> RunState:
    """One driver, which receives each request that `wish` returns as the run proceeds, once.

    Args: failures, how many of the first attempts at block 1 fail.
    """
    sent, left = set(), [failures]

    def show(state: RunState, _: Sequence[Stored]) -> None:
        wanted = wish(state)
        if wanted is not None and wanted not in sent:
            sent.add(wanted)
            control.send(harness.folder, *wanted)

    def fail(spec: WorkerSpec) -> TaskSpec:
        if spec.task != ONE or not left[0]:
            return spec
        left[0] -= 1
        return Broken(**vars(spec))

    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        control.begin(harness.folder)
        database.append([RunBegan("host", 1, resumed)])
        return Driver(harness.job, Journal(database, show), pool, Hooks(on_start=fail)).run()


def nothing(_: RunState) -> None:
    return None


def disturb(state: RunState) -> tuple[str, int | None] | None:
    """Pause block 0, retry block 1, then unpause block 0 and stop the run in the middle of it."""
    zero, one = state.task(ZERO), state.task(ONE)
    if zero.status == Status.RUNNING:
        return (Action.STOP, None) if zero.begun else (Action.PAUSE, 0)
    if one.status == Status.FAILED:
        return Action.RETRY, 1
    return (Action.UNPAUSE, 0) if (zero.status, one.status) == (Status.PAUSED, Status.DONE) else None


def test_a_run_that_is_paused_retried_stopped_and_resumed_ends_with_the_same_bytes(
    pool: RayPool, tmp_path: Path
) -> None:
    for name in ("calm", "disturbed"):
        (tmp_path / name).mkdir()
    calm, disturbed = (Harness(tmp_path / name, **SETTINGS) for name in ("calm", "disturbed"))
    assert drive(calm, pool, nothing).outcome == "done"
    with pytest.raises(KeyboardInterrupt):
        drive(disturbed, pool, disturb, failures=2)
    assert disturbed.state.outcome == "interrupted"
    assert drive(disturbed, pool, nothing, resumed=True).outcome == "done"
    assert disturbed.folder.point_cloud.read_bytes() == calm.folder.point_cloud.read_bytes()
    yielded = [record.task for record in disturbed.records(TaskYielded)]
    assert yielded == [ZERO, ZERO]
    begun = [record.iteration for record in disturbed.records(TaskStarted) if record.task == ZERO]
    assert begun[0] == 0 < begun[1] <= begun[2] < 360
    assert [record.final for record in disturbed.records(TaskFailed)] == [False, True]


CACHE = 1.0  # GiB
NEED = {TaskId.block(0): CACHE / 2, TaskId.block(1): 0.0}  # GiB of cache with which they still fit


@dataclass(frozen=True, eq=False, kw_only=True)
class Hungry(TrainSpec):
    """Trains if its image cache is small enough."""

    def run(self) -> Iterator[Event]:
        if self.config.cache.memory > NEED[self.task]:
            raise MemoryError("Unable to allocate 2.00 GiB")
        yield from super().run()


def test_blocks_without_memory_are_tried_otherwise_and_then_left(pool: RayPool, tmp_path: Path) -> None:
    def hungry(spec: WorkerSpec) -> TaskSpec:
        return Hungry(**vars(spec)) if spec.task in NEED else spec

    harness = Harness(tmp_path, cache={"memory": CACHE}, iterations=12, **SMALL)
    with closing(Database(harness.folder.database)) as database:
        driver = Driver(harness.job, Journal(database), pool, Hooks(on_start=hungry))
        with pytest.raises(RunError, match="block 1 failed and keeps its Stage I Gaussians"):
            driver.run()
    first, second = (harness.state.task(name) for name in NEED)
    assert (first.status, second.status) == (Status.DONE, Status.FAILED)
    reason = "out of memory: Unable to allocate 2.00 GiB; tried again with a smaller image cache"
    assert [task.reasons[0][: len(reason)] for task in (first, second)] == [reason] * 2
    assert len(first.reasons) == 1
    assert "no device has more memory" in second.reasons[-1]
    assert {failed.kind for failed in harness.records(TaskFailed)} == {Failure.MEMORY}
    merged, kept = read_ply(harness.folder.point_cloud), read_ply(harness.folder.kept(1))
    trained = read_ply(harness.folder.model(TaskId.block(0)))
    assert torch.equal(merged.means[: len(trained)], trained.means)
    assert torch.equal(merged.means[len(trained) : len(trained) + len(kept)], kept.means)
