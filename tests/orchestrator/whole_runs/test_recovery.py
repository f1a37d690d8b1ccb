"""A run with a real Ray in which one block needs less cache and another never has enough memory."""

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.pool import RayPool
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.resources.nodes import Place
from panolog.orchestrator.resources.pool import Work
from panolog.orchestrator.run.records import MEMORY, RunBegan, TaskFailed
from panolog.orchestrator.run.state import DONE, FAILED
from panolog.orchestrator.run.store import Database
from panolog.scene.errors import RunError
from panolog.scene.ply import read_ply
from panolog.workers.events import Event
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

CACHE = 1.0  # GiB
NEED = {"block/000": CACHE / 2, "block/001": 0.0}  # GiB of cache with which they still fit


def hungry(work: Work, need: float, **fields: Any) -> Iterator[Event]:
    if fields["config"].cache.memory > need:
        raise MemoryError("Unable to allocate 2.00 GiB")
    yield from work(**fields)


class TightPool(RayPool):
    """Its workers have little memory."""

    def start(self, name: str, place: Place, work: Work, fields: dict[str, Any]) -> None:
        super().start(name, place, partial(hungry, work, NEED[name]) if name in NEED else work, fields)


def test_blocks_without_memory_are_tried_otherwise_and_then_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.orchestrator.cluster.connection.RayPool", TightPool)
    harness = Harness(tmp_path, cache={"memory": CACHE}, sky={"count": 20}, iterations=12)
    with connect(None, harness.folder.root) as pool, closing(Database(harness.folder.database)) as database:
        driver = Driver(harness.job, database, pool, lambda state, news: None)
        with pytest.raises(RunError, match="block 1 failed and keeps its Stage I Gaussians"):
            driver.run(RunBegan("host", 1, resumed=False))
    first, second = (harness.state.task(name) for name in NEED)
    assert (first.status, second.status) == (DONE, FAILED)
    reason = "out of memory: Unable to allocate 2.00 GiB; tried again with a smaller image cache"
    assert [task.reasons[0][: len(reason)] for task in (first, second)] == [reason] * 2
    assert len(first.reasons) == 1
    assert "no device has more memory" in second.reasons[-1]
    assert {failed.kind for failed in harness.records(TaskFailed)} == {MEMORY}
    merged, kept = read_ply(harness.folder.point_cloud), read_ply(harness.folder.kept(1))
    trained = read_ply(harness.folder.model("block/000"))
    assert torch.equal(merged.means[: len(trained)], trained.means)
    assert torch.equal(merged.means[len(trained) : len(trained) + len(kept)], kept.means)
