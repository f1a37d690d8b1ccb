"""Workers that are silent: from when on they count as hung, and what follows."""

import math
from collections.abc import Callable, Iterator, Set
from dataclasses import asdict, dataclass
from typing import Any

import pytest

from panolog.orchestrator.engine.estimates.calibration import Basis
from panolog.orchestrator.engine.scheduling.pool import NONE, Ended, Failed, Message
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.folder import write_json
from panolog.orchestrator.runs.records import EvaluationSaved, Failure, ModelSaved, TaskFailed, TaskYielded
from panolog.orchestrator.runs.state import RunState, Status
from panolog.workers.events import Checkpoint, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, Progress, TaskId
from tests.orchestrator.calibrated import calibrated
from tests.orchestrator.fakes import MACHINE, FakePool, Harness, SetClock, begins, well

LIMIT = 600.0  # the default of both deadlines
STEP = 5.0  # seconds of a turn of the driver's loop


@dataclass(frozen=True)
class Silence:
    """Seconds until the next message of a script."""

    seconds: float


HANG = Silence(math.inf)
Timed = Callable[[TaskSpec], Iterator[Any]]  # events and silences


class TimedPool(SetClock, FakePool):
    """A pool with a clock of its own, which moves while the driver waits; the clock of the driver."""

    def __init__(self, script: Timed, before: dict[TaskId, list[Silence]] | None = None) -> None:
        """Args: before, the silence before the Hello of each attempt at a task."""
        SetClock.__init__(self)
        FakePool.__init__(self, script, [MACHINE])
        self.cancelled: list[TaskId] = []
        self.on_take: Callable[[TaskId, Message], None] = lambda task, message: None
        self.others = 0  # times that `waiting` is true
        self._before = before or {}
        self._next: dict[TaskId, tuple[float, Message]] = {}

    def waiting(self, task: TaskId) -> bool:
        self.others -= 1
        return self.others >= 0

    def cancel(self, task: TaskId) -> None:
        super().cancel(task)
        self._next.pop(task, None)
        self.cancelled.append(task)

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        for task, messages in self._running.items():
            if task not in self._next:
                due, message = self.now, next(messages)
                while isinstance(message, Silence):
                    due += message.seconds
                    message = Ended() if due == math.inf else next(messages)
                self._next[task] = due, message
        ready = [task for task, (due, _) in self._next.items() if due <= self.now and task not in ignored]
        if not self._running and self._when_waiting is not None:
            self._when_waiting()
        if not ready and seconds:
            self.now += STEP
        return ready

    def take(self, task: TaskId) -> Message:
        _, message = self._next.pop(task)
        if isinstance(message, Ended | Failed):
            del self._running[task]
        self.on_take(task, message)
        return message

    def _messages(self, spec: TaskSpec) -> Iterator[Message]:
        silences = self._before.get(spec.task, [])
        if silences:
            yield silences.pop(0)  # type: ignore[misc]
        yield from super()._messages(spec)


def drive(harness: Harness, pool: TimedPool) -> RunState:
    harness.clock = pool
    return harness.drive(pool=pool)


BLOCK = TaskId.block(0)


@pytest.mark.parametrize("task", [COARSE, TaskId.shard(0), BLOCK, EVAL])
def test_a_worker_that_is_silent_for_too_long_is_lost_and_its_task_tried_again(
    harness: Harness, task: TaskId
) -> None:
    pool = TimedPool(begins(task, Progress(task, 1, 9, 1.0), HANG))
    state = drive(harness, pool)
    (failed,) = harness.records(TaskFailed)
    assert (failed.task, failed.kind, failed.final) == (task, Failure.LOST, False)
    assert failed.reason == f"no message for {LIMIT + STEP:.0f} s: the worker hangs"
    assert pool.cancelled == [task]
    assert state.metrics is not None


def test_a_worker_that_does_not_begin_is_lost(harness: Harness) -> None:
    pool = TimedPool(well, {BLOCK: [HANG]})
    drive(harness, pool)
    (failed,) = harness.records(TaskFailed)
    assert (failed.task, failed.kind) == (BLOCK, Failure.LOST)
    assert failed.reason == "no message for 605 s since its start: the worker does not begin"


def test_a_task_that_waits_for_its_place_does_not_hang(harness: Harness) -> None:
    pool = TimedPool(well, {BLOCK: [Silence(5000)]})
    pool.others = 100
    drive(harness, pool)
    assert not pool.cancelled
    assert pool.others < 100


@pytest.mark.parametrize(("begin", "interval", "most"), [(0.5, 200.0, 2000.0), (300.0, 0.0, 3000.0)])
def test_a_task_may_be_silent_for_ten_times_its_usual_interval_or_what_the_calibration_needed(
    harness: Harness, begin: float, interval: float, most: float
) -> None:
    """The latter also at the start of an attempt that follows others: it reads its model again."""
    basis = Basis(calibrated(begin=begin), startup=3.0)
    write_json(harness.folder.preflight, {"basis": asdict(basis)})
    steps = [step for i in range(20) for step in (Silence(interval), Progress(BLOCK, i, 99, 1.0))]
    pool = TimedPool(begins(BLOCK, *steps, Silence(most - 10), Progress(BLOCK, 20, 99, 1.0), HANG))
    drive(harness, pool)
    (failed,) = harness.records(TaskFailed)
    assert failed.reason == f"no message for {most + STEP:.0f} s: the worker hangs"


@pytest.mark.parametrize(
    ("events", "slow", "kind", "seconds"),
    [
        # the driver saves a checkpoint for an hour, or its machine is asleep, while the other block is silent
        ([Progress(BLOCK, 1, 9, 1.0), Silence(4000)], TaskId.block(1), Checkpoint, 3600.0),
        # a message of the other block is there, however many turns those of this one take, all short
        ([Progress(BLOCK, i, 999, 1.0) for i in range(200)], BLOCK, object, STEP),
    ],
    ids=["one long turn", "many short ones"],
)
def test_the_time_in_which_the_driver_is_busy_does_not_count(
    harness: Harness, events: list[Event | Silence], slow: TaskId, kind: type, seconds: float
) -> None:
    pool = TimedPool(begins(BLOCK, *events))

    def save(task: TaskId, message: Message) -> None:
        pool.now += seconds if task == slow and isinstance(message, kind) else 0.0

    pool.on_take = save
    drive(harness, pool)
    assert not pool.cancelled


def test_a_process_that_does_not_end_after_its_result_is_no_failure(harness: Harness) -> None:
    def script(spec: TaskSpec) -> Iterator[Event | Silence]:
        yield from well(spec)
        if spec.task in (COARSE, BLOCK, EVAL):
            yield HANG

    pool = TimedPool(script)
    state = drive(harness, pool)
    assert pool.cancelled == [COARSE, BLOCK, EVAL]
    assert not harness.records(TaskFailed)
    assert len(harness.records(ModelSaved)) == 3
    assert len(harness.records(EvaluationSaved)) == 1
    assert state.status(BLOCK) == Status.DONE
    assert not harness.folder.checkpoint(BLOCK).exists()


def test_a_block_that_hangs_on_its_way_to_a_pause_is_paused(harness: Harness) -> None:
    pool = TimedPool(begins(BLOCK, Progress(BLOCK, 1, 9, 1.0), HANG))

    def pause(task: TaskId, message: Message) -> None:
        if task == BLOCK and isinstance(message, Progress) and not pool.cancelled:
            control.send(harness.folder, control.Action.PAUSE, BLOCK.number)

    pool.on_take = pause
    pool.when_waiting(lambda: control.send(harness.folder, control.Action.UNPAUSE, BLOCK.number))
    with lock.hold(harness.folder.lock):
        control.begin(harness.folder)
        drive(harness, pool)
    assert pool.cancelled == [BLOCK]
    assert [record.task for record in harness.records(TaskYielded)] == [BLOCK]
    assert not harness.records(TaskFailed)
