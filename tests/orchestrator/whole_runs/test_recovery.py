"""A run with a real Ray in which one block needs less cache and another never has enough memory."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.pool import RayPool
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.run.records import Failure, TaskFailed
from panolog.orchestrator.run.state import Status
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError
from panolog.scene.ply import read_ply
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

CACHE = 1.0  # GiB
NEED = {TaskId.block(0): CACHE / 2, TaskId.block(1): 0.0}  # GiB of cache with which they still fit


@dataclass(frozen=True, eq=False, kw_only=True)
class Hungry(TrainSpec):
    """Trains if its image cache is small enough."""

    def run(self) -> Iterator[Event]:
        if self.config.cache.memory > NEED[self.task]:
            raise MemoryError("Unable to allocate 2.00 GiB")
        yield from super().run()


class TightPool(RayPool):
    """Its workers have little memory."""

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        super().start(placement, Hungry(**vars(spec)) if spec.task in NEED else spec)


def test_blocks_without_memory_are_tried_otherwise_and_then_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.orchestrator.cluster.connection.RayPool", TightPool)
    harness = Harness(tmp_path, cache={"memory": CACHE}, sky={"count": 20}, iterations=12)
    with connect(None, harness.folder.root) as pool, closing(Database(harness.folder.database)) as database:
        driver = Driver(harness.job, Journal(database), pool)
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
