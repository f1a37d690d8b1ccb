"""A run with real workers that the requests of the control channel disturb."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.driver.attempts import WorkerSpec
from panolog.orchestrator.driver.driver import Driver, Hooks
from panolog.orchestrator.driver.journal import Journal
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.control import Action
from panolog.orchestrator.run.records import RunBegan, Stored, TaskFailed, TaskStarted, TaskYielded
from panolog.orchestrator.run.state import RunState, Status
from panolog.orchestrator.run.store import Database
from panolog.workers import stopping
from panolog.workers.events import Event, Preview
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import Harness

pytestmark = pytest.mark.system

ZERO, ONE = TaskId.block(0), TaskId.block(1)
SETTINGS: dict[str, Any] = {
    **{"sky": {"count": 20}, "partition": {"min_cameras": 1}},  # blocks have one or two
    **{"iterations": 60, "preview": {"every": 20}, "retries": 1},
}
Wish = Callable[[RunState], tuple[str, int | None] | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class Broken(TrainSpec):
    """Fails at once."""

    def run(self) -> Iterator[Event]:
        raise RuntimeError("broken")


@dataclass(frozen=True, eq=False, kw_only=True)
class Awaits(TrainSpec):
    """Waits in its middle until it is requested to stop, however quick it is."""

    def run(self) -> Iterator[Event]:
        for event in super().run():
            yield event
            while isinstance(event, Preview) and not stopping.requested():
                time.sleep(0.01)


def drive(harness: Harness, wish: Wish, *, failures: int = 0, resumed: bool = False) -> RunState:
    """One driver, which receives each request that `wish` returns as the run proceeds, once.

    Args: failures, how many of the first attempts at block 1 fail; block 0 waits for requests then.
    """
    sent, left = set(), [failures]

    def show(state: RunState, _: Sequence[Stored]) -> None:
        wanted = wish(state)
        if wanted is not None and wanted not in sent:
            sent.add(wanted)
            control.send(harness.folder, *wanted)

    def begin(spec: WorkerSpec) -> TaskSpec:
        if spec.task == ZERO and failures:
            return Awaits(**vars(spec))
        if spec.task != ONE or not left[0]:
            return spec
        left[0] -= 1
        return Broken(**vars(spec))

    with (
        lock.hold(harness.folder.lock),
        closing(Database(harness.folder.database)) as database,
        local_pool() as pool,
    ):
        control.begin(harness.folder)
        database.append([RunBegan("host", 1, resumed)])
        return Driver(harness.job, Journal(database, show), pool, Hooks(on_start=begin)).run()


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


def test_a_run_that_is_paused_retried_stopped_and_resumed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    for name in ("calm", "disturbed"):
        (tmp_path / name).mkdir()
    calm, disturbed = (Harness(tmp_path / name, **SETTINGS) for name in ("calm", "disturbed"))
    assert drive(calm, nothing).outcome == "done"
    with pytest.raises(KeyboardInterrupt):
        drive(disturbed, disturb, failures=2)
    assert disturbed.state.outcome == "interrupted"
    assert drive(disturbed, nothing, resumed=True).outcome == "done"
    assert disturbed.folder.point_cloud.read_bytes() == calm.folder.point_cloud.read_bytes()
    yielded = [record.task for record in disturbed.records(TaskYielded)]
    assert yielded == [ZERO, ZERO]
    begun = [record.iteration for record in disturbed.records(TaskStarted) if record.task == ZERO]
    assert begun[0] == 0 < begun[1] <= begun[2] < 60
    assert [record.final for record in disturbed.records(TaskFailed)] == [False, True]
