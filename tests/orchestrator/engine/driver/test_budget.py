"""A driver with limits of cost and time, by a clock that the test sets."""

import errno
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.engine.driver import driver, saving
from panolog.orchestrator.engine.driver.purse import require_enough, verdict
from panolog.orchestrator.engine.estimates.costs import slowness
from panolog.orchestrator.engine.scheduling.scaling import STARTUP_S
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.money.account import lost_with_driver
from panolog.orchestrator.runs.money.records import (
    BudgetNear,
    BudgetReached,
    BudgetSet,
    NodeReserved,
    WorkLost,
)
from panolog.orchestrator.runs.records import Outcome, PreflightSaved, Record, RunBegan, Stored
from panolog.orchestrator.runs.state import RunState, Status, replay
from panolog.scene.errors import ConfigError, RunError
from panolog.scene.model import Scene
from panolog.scene.ply import read_ply
from panolog.workers.events import Checkpoint, Event, Preview
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, DELIVER, EVAL, MERGE, Progress, TaskId
from panolog.workers.training.optimizer import ModelState
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import (
    DIED,
    MACHINE,
    CrashError,
    FakePool,
    Harness,
    SetClock,
    begins,
    trained,
    well,
)

PRICES = {"currency": "USD", "machine": [{"name": "any", "price": 3600.0, "host": "*"}]}  # 1 USD per second
AFTER = {"merge": 1.0, "eval": 5.0, "deliver": 4.0}  # seconds: 12 with what is unsure of them
BLOCK = TaskId.block(1)


class Limited(Harness):
    def __init__(self, folder: Path, budget: BudgetSet, **settings: Any) -> None:
        super().__init__(folder, **settings)
        self.clock = SetClock()
        self.begin(budget)

    def begin(self, budget: BudgetSet | None = None) -> None:
        with closing(Database(self.folder.database, self.clock)) as database:
            lost = lost_with_driver(self.state)
            new = [] if self.state.began else [PreflightSaved("preflight.json", dict(AFTER))]
            database.append([*lost, RunBegan("host", 1, False, self.state.latest), *new])
            database.append([budget] if budget else [])

    def passes(self, seconds: float) -> None:
        self.clock.sleep(seconds)


def slow(harness: Limited, seconds: dict[TaskId, float], step: float = 1.0) -> Any:

    def script(spec: TaskSpec) -> Iterator[Event]:
        left = seconds.get(spec.task, 0.0)
        while left > 0:
            harness.passes(step)
            left -= step
            yield Progress(spec.task, 1, 2, 3.0)
            if spec.task in harness.pool.stopped and isinstance(spec, TrainSpec):
                yield saved(spec)
                return
        yield from well(spec)

    return script


def saved(spec: TrainSpec, iteration: int = 20_000) -> Checkpoint:
    """A checkpoint of what a task would end with, a little darker."""
    gaussians = trained(spec)
    darker = replace(gaussians, sh0=gaussians.sh0 - 7)
    return Checkpoint(spec.task, iteration, ModelState.start(darker).tensors())


def test_a_limit_is_not_outlasted_by_a_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that was full for eight hours cost eight hours of all machines, whatever the limit."""
    harness, real = Limited(tmp_path, BudgetSet(max_cost=100.0, prices=PRICES)), saving.save
    full = harness.clock.time() + 8 * 3600

    def save(folder: RunFolder, event: Event, scene: Scene, keep: int = 1) -> Record:
        if isinstance(event, Preview) and harness.clock.time() < full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(folder, event, scene, keep)

    def script(spec: TaskSpec) -> Iterator[Event]:
        if spec.task == COARSE:
            harness.passes(10)
            yield Progress(COARSE, 1, 2, 3.0)
            yield Preview(COARSE, 1, "a.jpg", b"picture")
        yield from well(spec)

    monkeypatch.setattr(driver, "save", save)
    with pytest.raises(RunError, match=r"space.*, and the limit of 100 USD is reached"):
        harness.drive(script)
    assert 85 <= harness.state.money.used.cost <= 100
    harness.passes(full - harness.clock.time())
    harness.begin(BudgetSet(max_cost=1e6, prices=PRICES))
    assert harness.drive(script, resumed=True).outcome == "done"


def test_a_limit_merges_what_there_is_and_a_higher_one_completes_the_run_with_the_same_bytes(
    tmp_path: Path,
) -> None:
    harness = Limited(tmp_path, BudgetSet(max_cost=100.0, prices=PRICES))
    whole = harness.at(tmp_path / "whole")
    whole.drive()
    state = harness.drive(slow(harness, {COARSE: 20, BLOCK: 500, EVAL: 10}))
    assert (state.outcome, state.status(BLOCK)) == (Outcome.LIMITED, Status.WAITING)
    assert "the limit of 100 USD is reached" in state.reason
    assert 95 <= state.money.used.cost <= 100
    assert state.task(BLOCK).checkpoint == 20_000
    assert state.merged is not None
    assert state.metrics == {"psnr": 24.0, "lpips": None}
    assert len(harness.records(BudgetNear)) == 1
    merged, other = read_ply(harness.folder.point_cloud), read_ply(whole.folder.point_cloud)
    assert len(merged) == len(other)
    early = merged.sh0[:, 0, 0] < other.sh0[:, 0, 0] - 6
    assert 0 < int(early.sum()) < len(merged)  # one block is that of its checkpoint, which is darker
    assert harness.state == state
    harness.passes(1000)  # nothing is counted while no driver is at work
    harness.begin(BudgetSet(max_cost=1000.0, prices=PRICES))
    assert harness.state.status(MERGE) == Status.WAITING
    assert harness.state.merged is None
    state = harness.drive(slow(harness, {BLOCK: 30, EVAL: 10}), resumed=True)
    assert state.outcome == Outcome.DONE
    assert harness.trainings(BLOCK)[0].checkpoint is not None
    assert harness.folder.point_cloud.read_bytes() == whole.folder.point_cloud.read_bytes()
    assert not list(harness.folder.root.rglob("early.ply"))
    assert not list(harness.folder.root.rglob("checkpoint.safetensors"))
    assert state.money.used.cost < 200


def test_a_block_that_has_hardly_begun_keeps_its_stage_one_gaussians(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(max_cost=60.0, prices=PRICES))

    def script(spec: TaskSpec) -> Iterator[Event]:
        for event in slow(harness, {BLOCK: 500})(spec):
            yield saved(spec, 100) if isinstance(event, Checkpoint) and isinstance(spec, TrainSpec) else event

    state = harness.drive(script)
    assert state.outcome == Outcome.LIMITED
    assert harness.folder.kept(1).exists()
    assert not harness.folder.early(BLOCK).exists()


def test_a_deadline_in_stage_one_delivers_its_checkpoint(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(deadline=1e9 + 50))
    state = harness.drive(slow(harness, {COARSE: 500, EVAL: 10}))
    assert (state.outcome, state.status(COARSE)) == (Outcome.LIMITED, Status.WAITING)
    assert "the deadline" in state.reason
    assert state.merged is not None
    assert (state.merged.gaussians, state.merged.sky) == (202, 2)
    assert state.metrics is not None
    assert 45 <= harness.clock.time() - 1e9 <= 50
    assert harness.state == state
    harness.begin(BudgetSet())
    assert harness.drive(resumed=True).outcome == Outcome.DONE


def test_districts_that_were_not_begun_are_missing_from_an_early_model(tmp_path: Path) -> None:
    nodes = [Node("node", "host", cpus=1, memory=2**40)]
    settings = {"districts": 2, "overlap": 0.0, "partition": {"min_cameras": 1}, "blocks": "1x1x1"}
    harness = Limited(tmp_path, BudgetSet(max_cost=60.0, prices=PRICES), nodes=nodes, **settings)
    state = harness.drive(slow(harness, {TaskId.district(0): 500}))
    assert state.outcome == Outcome.LIMITED
    assert any("1 of 2 districts were not begun" in notice.message for notice in state.notices)
    assert state.merged is not None
    assert 2 < state.merged.gaussians < 202


def test_a_limit_before_the_first_checkpoint_leaves_no_model_and_one_after_the_training_ends_nothing(
    tmp_path: Path,
) -> None:
    harness = Limited(tmp_path, BudgetSet(max_cost=30.0, prices=PRICES))

    def script(spec: TaskSpec) -> Iterator[Event]:
        while spec.task not in harness.pool.stopped:
            harness.passes(1)
            yield Progress(spec.task, 1, 2, 3.0)

    state = harness.drive(script)
    assert (state.outcome, state.merged) == (Outcome.LIMITED, None)
    harness.begin(BudgetSet(max_cost=60.0, prices=PRICES))
    state = harness.drive(slow(harness, {EVAL: 100}), resumed=True)
    assert (state.outcome, len(harness.records(BudgetReached))) == (Outcome.DONE, 1)


def test_a_driver_that_dies_after_a_limit_leaves_the_rest_to_the_next(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(max_cost=60.0, prices=PRICES))
    steps = (lambda: harness.stop.signal()), Progress(EVAL, 1, 2, 3.0)  # noqa: PLW0108  # drive makes a new one
    with pytest.raises(KeyboardInterrupt):
        harness.drive(begins(EVAL, *steps, rest=slow(harness, {BLOCK: 500})))
    assert harness.state.outcome == Outcome.INTERRUPTED
    harness.begin()
    state = harness.drive(resumed=True)
    assert (state.outcome, harness.tasks) == (Outcome.LIMITED, [EVAL])


def test_another_share_of_a_machine_has_another_price(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(max_cost=1e9, prices=PRICES))

    def begins_beside_us() -> None:
        harness.pool.leave(MACHINE.id)
        harness.pool.join(replace(MACHINE, share=0.5))

    harness.drive(begins(COARSE, begins_beside_us))
    assert [record.price for record in harness.records(NodeReserved)] == [3600.0, 1800.0]


def test_what_attempts_and_killed_drivers_lose_is_recorded(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(prices=PRICES))
    saved = (lambda: harness.passes(10)), Checkpoint(COARSE, 1, {"x": torch.arange(3)})
    lost = *saved, (lambda: harness.passes(4)), Progress(COARSE, 2, 2, 3.0)
    killed = begins(COARSE, *lost, SystemExit(), rest=slow(harness, {EVAL: 6}))
    with pytest.raises(SystemExit):
        harness.drive(begins(COARSE, *lost, CrashError(DIED), rest=killed))
    harness.begin()
    state = harness.drive(killed, resumed=True)
    assert [(record.task, record.seconds) for record in harness.records(WorkLost)] == [(COARSE, 4.0)] * 2
    assert (state.money.lost.cost, state.money.used.cost) == pytest.approx((8.0, 34.0))


@pytest.mark.parametrize(
    ("budget", "message"),
    [
        (BudgetSet(max_cost=13.0, prices=PRICES), "which cost 14 USD; give more"),
        (BudgetSet(deadline=1013.0), "0:13 are left, and merge, evaluation and delivery alone"),
    ],
)
def test_a_budget_that_leaves_no_time_to_train_is_refused(budget: BudgetSet, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        require_enough(AFTER, budget, [MACHINE], 1000.0)
    require_enough(AFTER, BudgetSet(max_cost=20.0, deadline=1020.0, prices=PRICES), [MACHINE], 1000.0)


def test_where_stage_one_was_slower_than_estimated_more_is_kept_for_what_follows(tmp_path: Path) -> None:
    harness = Limited(tmp_path, BudgetSet(prices=PRICES))
    coarse = replace(harness.state.task(COARSE), status=Status.DONE, seconds=30.0, iterations=2)
    state = replace(harness.state, tasks={COARSE: coarse}, estimate={**AFTER, "coarse": 10.0})
    assert slowness(state) == pytest.approx(3.0)
    assert slowness(replace(state, estimate={**AFTER, "coarse": 100.0})) == 1.0
    assert slowness(replace(state, estimate=None)) == 1.0
    money = replace(state.money, budget=BudgetSet(deadline=1e9 + 39), since=1e9 - 1000)
    assert isinstance(verdict(replace(state, money=money), 1e9, 1.0), BudgetReached)  # 36 + 1 + 2 seconds
    money = replace(money, budget=BudgetSet(deadline=1e9 + 40))
    assert isinstance(verdict(replace(state, money=money), 1e9, 1.0), BudgetNear)


def test_where_idle_machines_go_less_is_reserved_in_cost_and_more_in_time() -> None:
    """Of ten machines nine end a minute after the training, and one has to start again after the merge."""
    at = 1e9
    records: list[Record] = [RunBegan("host", 1, False), PreflightSaved("preflight.json", dict(AFTER))]
    machines = [NodeReserved(str(i), "host", "small", 3600.0) for i in range(10)]

    def found(now: float, idle: float | None, **limits: Any) -> BudgetNear | BudgetReached | None:
        budget = BudgetSet(prices=PRICES, **limits)
        all_of: list[Record] = [*records, budget, *machines]
        state = replay(Stored(i, at, record) for i, record in enumerate(all_of, 1))
        return verdict(state, at + now, 1.0, idle)

    needed = 1.2 * sum(AFTER.values()) + 3
    cost = 1000 + 10 * 60 + needed + STARTUP_S - 60  # 100 seconds of ten machines, and what follows
    assert isinstance(found(100, 60, max_cost=cost - 20), BudgetReached)
    assert not isinstance(found(100, 60, max_cost=cost + 20), BudgetReached)
    assert isinstance(found(100, None, deadline=at + 100 + needed - 1), BudgetReached)
    assert not isinstance(found(100, None, deadline=at + 100 + needed + 1), BudgetReached)
    assert isinstance(found(100, 60, deadline=at + 100 + needed + STARTUP_S - 1), BudgetReached)


@pytest.mark.parametrize("comes_back", [False, True])
def test_after_a_limit_the_evaluation_waits_for_a_machine_for_so_long_and_not_for_ever(
    tmp_path: Path, comes_back: bool
) -> None:
    """The head of a cluster whose machines had gone stayed paid, whatever the limit."""
    harness = Limited(tmp_path, BudgetSet(max_cost=100.0, prices=PRICES), deliver=True)
    pool, began = FakePool(slow(harness, {COARSE: 20, BLOCK: 500}), [MACHINE]), harness.clock.time()

    def watch(state: RunState, _: object) -> None:
        if state.money.reached is not None and not state.tasks.keys() & {EVAL, MERGE}:
            pool.lose(MACHINE.id)

    def wait() -> None:
        harness.passes(20)
        if comes_back and harness.clock.time() > began + 400:
            pool.join(MACHINE)

    pool.when_waiting(wait)
    state = harness.drive(pool=pool, on_change=watch)
    assert state.outcome == Outcome.LIMITED and state.merged is not None
    assert state.status(DELIVER) == Status.DONE  # which needs no machine
    said = [notice.message for notice in state.notices if notice.task == EVAL]
    if comes_back:
        assert state.metrics == {"psnr": 24.0, "lpips": None} and said == []
    else:
        assert state.metrics is None
        assert said == ["not evaluated: no machine for 10:00 after the limit; `panolog eval` does that"]
        assert 600 <= harness.clock.time() - began <= 800
