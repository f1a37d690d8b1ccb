"""A run with a real Ray that is disturbed in every way that its control channel knows, and ends the same."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.cluster.connection import connect
from panolog.orchestrator.cluster.pool import RayPool
from panolog.orchestrator.driver.driver import Driver
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.control import Action
from panolog.orchestrator.run.records import RunBegan, Stored, TaskFailed, TaskStarted, TaskYielded
from panolog.orchestrator.run.state import RunState, Status
from panolog.orchestrator.run.store import Database
from panolog.workers.events import Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

ZERO, ONE = TaskId.block(0), TaskId.block(1)
SETTINGS: dict[str, Any] = {"sky": {"count": 20}, "iterations": 120, "retries": 1}
Wish = Callable[[RunState], tuple[str, int | None] | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class Broken(TrainSpec):
    def run(self) -> Iterator[Event]:
        raise RuntimeError("broken")


class BrokenPool(RayPool):
    """Its first attempts at one block fail."""

    failures = 0  # that are left

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        if spec.task == ONE and self.failures:
            self.failures -= 1
            spec = Broken(**vars(spec))
        super().start(placement, spec)


def drive(harness: Harness, pool: RayPool, wish: Wish, *, resumed: bool = False) -> RunState:
    """One driver, which receives each request that `wish` returns as the run proceeds, once."""
    sent = set()

    def show(state: RunState, _: Sequence[Stored]) -> None:
        wanted = wish(state)
        if wanted is not None and wanted not in sent:
            sent.add(wanted)
            control.send(harness.folder, *wanted)

    with lock.hold(harness.folder.lock), closing(Database(harness.folder.database)) as database:
        control.begin(harness.folder)
        database.append([RunBegan("host", 1, resumed)])
        return Driver(harness.job, Journal(database, show), pool).run()


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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.orchestrator.cluster.connection.RayPool", BrokenPool)
    for name in ("calm", "disturbed"):
        (tmp_path / name).mkdir()
    calm, disturbed = (Harness(tmp_path / name, **SETTINGS) for name in ("calm", "disturbed"))
    with connect(None, tmp_path) as pool:
        assert drive(calm, pool, nothing).outcome == "done"
        assert isinstance(pool, BrokenPool)
        pool.failures = 2
        with pytest.raises(KeyboardInterrupt):
            drive(disturbed, pool, disturb)
        assert disturbed.state.outcome == "interrupted"
        assert drive(disturbed, pool, nothing, resumed=True).outcome == "done"
    assert disturbed.folder.point_cloud.read_bytes() == calm.folder.point_cloud.read_bytes()
    yielded = [record.task for record in disturbed.records(TaskYielded)]
    assert yielded == [ZERO, ZERO]
    begun = [record.iteration for record in disturbed.records(TaskStarted) if record.task == ZERO]
    assert begun[0] == 0 < begun[1] <= begun[2] < 120
    assert [record.final for record in disturbed.records(TaskFailed)] == [False, True]
