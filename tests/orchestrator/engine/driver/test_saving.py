"""What comes to the disk: large messages on their way there, and records while a reader has run.db locked."""

import signal
import sqlite3
import subprocess
import sys
import threading
import weakref
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from panolog.orchestrator.engine.driver import driver as driver_module
from panolog.orchestrator.engine.driver import journal as journal_module
from panolog.orchestrator.engine.driver import saving, writers
from panolog.orchestrator.engine.driver.journal import Backlog, Journal
from panolog.orchestrator.engine.driver.writers import LARGE
from panolog.orchestrator.engine.estimates.calibration import CHECKPOINT
from panolog.orchestrator.engine.scheduling.large_messages import Large, announced
from panolog.orchestrator.engine.scheduling.pool import Message
from panolog.orchestrator.runs.database import Database, read_records
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.presence import Presence
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    ModelSaved,
    Noticed,
    Progressed,
    Record,
    RunBegan,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState, Status, TaskState
from panolog.workers.events import Checkpoint, CheckpointWritten, Event, Notice, Trained
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, Progress, Stage, TaskId
from panolog.workers.training import checkpoint
from panolog.workers.training.checkpointing import Outbox, Saver
from panolog.workers.training.task_config import CheckpointConfig
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.fakes import FakePool, Harness, trained, well

MANY = Node("node", "host", cpus=16, memory=2**44)
STATE = Checkpoint(COARSE, 7, {"x": torch.arange(1000)})


class Census:
    """Counts the large messages that were taken from a pool and are still in memory."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.most = 0
        self._lock = threading.RLock()
        self._take = FakePool.take
        monkeypatch.setattr(FakePool, "take", lambda pool, task: self._counted(self._take(pool, task)))

    def _counted(self, event: Message) -> Message:
        if not isinstance(event, Checkpoint | Trained):
            return event
        event = replace(event)  # the worker may keep its own
        weakref.finalize(event, self._gone)
        with self._lock:
            self.now += 1
            self.most = max(self.most, self.now)
        return event

    def _gone(self) -> None:
        with self._lock:
            self.now -= 1


def test_a_driver_holds_two_large_messages_whatever_the_number_of_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writers wait for the disk side by side, and the progress of other tasks is recorded meanwhile.

    What follows a message of the same task is recorded after it.
    """
    harness, census = Harness(tmp_path, [MANY], blocks="4x2x1"), Census(monkeypatch)

    def script(spec: TaskSpec) -> Iterator[Event]:
        if not isinstance(spec, TrainSpec) or spec.cell is None:
            yield from well(spec)
            return
        yield Progress(spec.task, 1, 9, 1.0)
        yield Checkpoint(spec.task, 1, {"x": torch.zeros(1000)})
        yield Progress(spec.task, 2, 9, 1.0)
        yield Trained(spec.task, trained(spec), 9, 0.1)

    def slow(folder: Any, event: Event, *rest: Any) -> Record:
        if isinstance(event, Checkpoint) and event.task.stage is Stage.BLOCK:
            blocks = sum(block.train for block in harness.state.plan or ())
            begun = {p.task for p in harness.records(Progressed) if p.task.stage is Stage.BLOCK}
            assert len(begun) == blocks > LARGE  # the loop has not stopped for this thread
            assert census.now <= LARGE
            threading.Event().wait(0.05)  # a record that came too early would come now
        return saving.save(folder, event, *rest)

    monkeypatch.setattr(driver_module, "save", slow)
    assert harness.drive(script).outcome == "done"
    assert 1 <= census.most <= LARGE
    assert census.now == 0
    order = defaultdict[TaskId, list[int]](list)
    for record in harness.records(Progressed | CheckpointSaved):  # type: ignore[arg-type]
        order[record.task].append(record.iteration)
    del order[COARSE]
    assert len(order) > LARGE and all(iterations == [1, 1, 2] for iterations in order.values())


def test_messages_without_announcement_make_no_room_for_others() -> None:
    done = threading.Event()

    def save(event: Event) -> Record:
        done.wait()
        return TaskYielded(event.task)

    some = writers.Writers(save, None)  # type: ignore[arg-type]
    tasks = [TaskId.block(number) for number in range(9)]
    for task in tasks[:4]:
        some.start(replace(STATE, task=task))
    for task in tasks[4:]:
        some.announce(task, 1)
    assert some.held_up() == set(tasks)
    done.set()
    some.close()
    assert some.held_up() == set(tasks[4 + LARGE :])


def test_a_worker_announces_what_is_large_and_has_one_such_message_unread() -> None:
    small, large = Progress(COARSE, 1, 9, 1.0), STATE
    sent = list(announced([small, large, small, large], ahead=8))
    kinds = [type(message) for message in sent]
    assert kinds == [Progress, Large, Checkpoint, Progress, *[Large] * 7, Checkpoint]
    assert sent[1] == Large(8000)
    assert [type(m) for m in announced([large, large])] == [Large, Checkpoint, Large, Checkpoint]


# Workers that write into the run folder


@pytest.fixture
def outbox(harness: Harness) -> Outbox:
    token = Presence(harness.folder.presence).token
    return saving.make_outbox(harness.folder, COARSE, 1, token)


def events(saver: Saver, state: Checkpoint = STATE) -> list[Event]:
    return list(saver.save(lambda _: state, last=False))


def test_a_worker_that_sees_the_run_folder_writes_its_checkpoint(harness: Harness, outbox: Outbox) -> None:
    (event,) = events(Saver(CheckpointConfig(), outbox))
    assert isinstance(event, CheckpointWritten)
    path = harness.folder.checkpoint(COARSE)
    assert not path.exists()
    size = (path.parent / event.name).stat().st_size
    assert saving.save(harness.folder, event, harness.job.scene) == CheckpointSaved(
        COARSE, 7, "coarse/checkpoint.safetensors", size
    )
    assert torch.equal(checkpoint.load(path).tensors["x"], STATE.tensors["x"])
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("change", [{"token": "0" * 16}, {"marker": Path("/nowhere/driver")}])
def test_a_worker_elsewhere_sends_its_checkpoint(outbox: Outbox, change: dict[str, Any]) -> None:
    """Another machine may have a folder under the same path, for instance a copy of an older run."""
    assert events(Saver(CheckpointConfig(), replace(outbox, **change))) == [STATE]


def test_a_worker_that_cannot_write_says_so_and_sends_its_checkpoint(outbox: Outbox) -> None:
    saver = Saver(CheckpointConfig(), replace(outbox, folder=outbox.folder / "gone"))
    notice, event = events(saver)
    assert isinstance(notice, Notice)
    assert "No such file" in notice.message
    assert isinstance(event, Checkpoint)
    assert event.iteration == STATE.iteration
    assert torch.equal(event.tensors["x"], STATE.tensors["x"])


def test_a_worker_leaves_one_file_at_a_time(harness: Harness, outbox: Outbox) -> None:
    saver = Saver(CheckpointConfig(), outbox)
    (first,) = events(saver)
    assert events(saver, replace(STATE, iteration=8)) == []  # the driver has not taken the first
    (last,) = saver.save(lambda _: replace(STATE, iteration=9), last=True)
    for event in (first, last):
        saving.save(harness.folder, event, harness.job.scene)
    assert checkpoint.iteration_of(harness.folder.checkpoint(COARSE)) == 9
    assert len(events(saver, replace(STATE, iteration=10))) == 1


def test_the_file_of_an_attempt_that_is_over_replaces_nothing(harness: Harness, outbox: Outbox) -> None:
    (late,) = events(Saver(CheckpointConfig(), outbox))
    assert isinstance(late, CheckpointWritten)
    successor = saving.make_outbox(harness.folder, COARSE, 2, outbox.token)
    assert not list(outbox.folder.iterdir())  # what the first has left is gone
    (event,) = events(Saver(CheckpointConfig(), successor), replace(STATE, iteration=9))
    saving.save(harness.folder, event, harness.job.scene)
    events(Saver(CheckpointConfig(), outbox))  # a machine that comes back to life writes its file now
    assert checkpoint.iteration_of(harness.folder.checkpoint(COARSE)) == 9
    saving.remove_checkpoints(harness.folder, COARSE)
    assert not list(outbox.folder.iterdir())


@pytest.mark.parametrize("content", [None, b"", b"not a checkpoint"])
def test_a_file_that_is_not_whole_is_left_out(
    harness: Harness, outbox: Outbox, content: bytes | None
) -> None:
    (event,) = events(Saver(CheckpointConfig(), outbox))
    assert isinstance(event, CheckpointWritten)
    path = outbox.folder / event.name
    path.unlink() if content is None else path.write_bytes(content)
    record = saving.save(harness.folder, event, harness.job.scene)
    assert "iteration 7 was lost" in getattr(record, "message", "")
    assert not list(outbox.folder.iterdir())


# How often, and how long at the end


def test_saving_takes_at_most_its_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("panolog.workers.training.checkpointing.time.monotonic", lambda: now[0])
    saver, saved = Saver(CheckpointConfig(every=10, share=0.02), None), list[float]()

    def state(_: object) -> Checkpoint:
        now[0] += 2.0  # seconds that a checkpoint takes
        return STATE

    for iteration in range(1, 10_001):
        now[0] += 0.1
        if saver.due(iteration):
            saved.append(now[0])
            list(saver.save(state, last=False))
    periods, rest = len(saved) - 1, saved[-1] - saved[0]  # each begins with a checkpoint
    assert 0.019 < 2.0 * periods / rest <= 0.0201


def test_the_grace_follows_bytes_and_the_measured_rate() -> None:
    some = writers.Writers(lambda _: TaskYielded(COARSE), None)  # type: ignore[arg-type]
    tasks = [TaskId.block(number) for number in range(80)]
    state = RunState({task: TaskState(task, progress=Progressed(task, 1, 9, 1.0)) for task in tasks})
    assert some.grace(state, tasks) == writers.GRACE_S  # of unknown size
    some.measured(CheckpointSaved(COARSE, 1, "", 10**9), 10.0)
    large = Progressed(COARSE, 1, 9, 1.0, gaussians=2 * 10**9 // CHECKPOINT)
    state = RunState({task: TaskState(task, progress=large) for task in tasks})
    assert some.grace(state, tasks) == pytest.approx(writers.GRACE_S + 1600)


# A reader that begins to read and does not end.
_READER = """
import sqlite3, sys
reader = sqlite3.connect(sys.argv[1], isolation_level=None)
reader.execute("BEGIN")
reader.execute("SELECT COUNT(*) FROM events").fetchone()
print("reads", flush=True)
sys.stdin.read()
"""
SAVED = CheckpointSaved(COARSE, 2, "p", 1)
DONE = ModelSaved(COARSE, "coarse/model.ply", 1, 1, 2, 1.0)


@contextmanager
def locked(path: Path) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-c", _READER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reads\n"
        try:
            yield reader
        finally:
            reader.kill()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(journal_module, "_TRY_S", 0.01)
    monkeypatch.setattr(journal_module, "TIMEOUT_S", 0.1)
    return tmp_path / "run.db"


def test_records_wait_and_keep_their_order_and_times(path: Path) -> None:
    with closing(Database(path)) as database:
        shown: list[object] = []
        journal = Journal(database, lambda _, news: shown.extend(item.record for item in news))
        journal.record([RunBegan("host", 1, resumed=False)])
        with locked(path) as reader:
            journal.record([Progressed(COARSE, 1, 2, 1.0)])
            journal.record([SAVED])
            assert journal.state.task(COARSE).checkpoint == 2
            assert len(read_records(path)) == 1
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                journal.record([DONE])  # its checkpoint is removed next
            assert journal.state.status(COARSE) != Status.DONE
        journal.record([])
        assert len(read_records(path)) == 4
        journal.record([DONE])
    _, progress, notice, saved, done = read_records(path)
    assert (progress.record, saved.record) == (Progressed(COARSE, 1, 2, 1.0), SAVED)
    assert done.record == DONE
    assert isinstance(notice.record, Noticed)
    assert f"(process {reader.pid}): records wait in memory" in notice.record.message
    assert progress.time == notice.time < saved.time < done.time
    assert [type(record) for record in shown] == [type(item.record) for item in read_records(path)]


def test_only_so_many_wait(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MOST", 3)
    with closing(Database(path)) as database, locked(path):
        waiting = Backlog(database)
        waiting.store([SAVED])
        waiting.store([SAVED])
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            waiting.store([SAVED])
        assert len(waiting) == 3  # with the notice


def test_ctrl_c_ends_the_wait(path: Path) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with closing(Database(path)) as database, locked(path), pytest.raises(KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            Backlog(database).store([DONE], wait_s=60)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert read_records(path) == []
