"""Requests to a run reach its driver, and malformed ones are ignored."""

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.control import Action, ControlRequest, answer, refusal
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import (
    BlockPlan,
    Failure,
    Merged,
    NodeQuarantined,
    NodeReleased,
    Noticed,
    Part,
    PauseRequested,
    PlanSaved,
    Record,
    RetryRequested,
    RunContinued,
    RunWaiting,
    ScoresSaved,
    TaskFailed,
    TaskYielded,
    UnpauseRequested,
)
from panolog.orchestrator.runs.state import RunState, Status
from panolog.orchestrator.watch.views.summary import summarize
from panolog.scene.errors import InputError
from panolog.workers.events import Checkpoint, Event
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import COARSE, EVAL, Progress, Stage, TaskId
from panolog.workers.training.checkpoint import CheckpointFile
from tests.orchestrator.fakes import DIED, CrashError, Harness, begins, well
from tests.orchestrator.history import AGAIN, after, model, started

ZERO, ONE = TaskId.block(0), TaskId.block(1)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[RunFolder]:
    """A run folder with a driver that listens."""
    folder = RunFolder(tmp_path)
    with lock.hold(folder.lock):
        assert control.begin(folder) == []
        yield folder


def put(folder: RunFolder, name: str, content: bytes) -> None:
    (folder.control / name).write_bytes(content)


def test_a_full_disk_takes_no_request_and_says_what_does(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("panolog.orchestrator.runs.control.write_bytes", full)
    with pytest.raises(InputError, match=r"its disk is full.* free some space, or stop the run with Ctrl-C"):
        control.send(folder, Action.STOP)


def test_requests_are_taken_once_and_in_order(folder: RunFolder) -> None:
    for action, block in ((Action.PAUSE, 3), (Action.STOP, None), (Action.UNPAUSE, 3)):
        control.send(folder, action, block)
    assert control.take(folder) == [
        ControlRequest(Action.PAUSE, 3),
        ControlRequest(Action.STOP),
        ControlRequest(Action.UNPAUSE, 3),
    ]
    assert control.take(folder) == []
    assert list(folder.control.iterdir()) == []


def test_what_says_nothing_is_not_sent(folder: RunFolder) -> None:
    with pytest.raises(InputError, match="needs the number of a block"):
        control.send(folder, Action.PAUSE)
    assert control.take(folder) == []


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b'{"block": 1}',
        b'{"action": "pause"}',
        b'{"action": "stop", "path": "/etc"}',
        b'{"action": "stop", "block": 1}',
        b'{"action": "\\ud800", "block": 1}',
        b'{"action": "pause", "block": 1.0}',
        b'{"action": "pause", "block": -1}',
        b'{"action": "retry", "block": "1"}',
        b'{"action": "retry", "block": true}',
        b'{"action": "release"}',
        b'{"action": "release", "block": 1}',
        b'{"action": "release", "node": 7}',
        b'{"action": "release", "node": "a/../b"}',
        b'{"action": "release", "node": "\\ud800"}',
        b'{"action": "pause", "block": 1, "node": "a"}',
        b"[" * 250,
        b'{"action": "stop"}' + b" " * 10_000,
    ],
)
def test_nonsense_becomes_a_notice(folder: RunFolder, content: bytes) -> None:
    put(folder, "1.json", content)
    (said,) = control.take(folder)
    assert isinstance(said, Noticed)
    assert said.message.startswith("control/'1.json' is not a request: ")
    assert said.message.isascii()
    assert list(folder.control.iterdir()) == []


def test_what_is_no_plain_file_is_not_read(folder: RunFolder, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text('{"action": "stop"}')
    (folder.control / "1.json").symlink_to(secret)
    os.mkfifo(folder.control / "2.json")
    (folder.control / "3.json").mkdir()
    put(folder, ".4.json.abcd.part", b'{"action": "stop"}')  # being written
    assert [type(said) for said in control.take(folder)] == [Noticed, Noticed]
    assert control.take(folder) == []
    assert secret.exists()


def test_a_flood_is_taken_piece_by_piece(folder: RunFolder) -> None:
    for i in range(150):
        put(folder, f"{i:03d}.json", b'{"action": "stop"}')
    assert [len(control.take(folder)) for _ in range(3)] == [100, 50, 0]


def test_a_new_driver_does_nothing_of_what_was_requested_of_an_older_one(folder: RunFolder) -> None:
    control.send(folder, Action.PAUSE, 2)
    assert [said.message for said in control.begin(folder)] == [
        "pause block 2: was requested of an earlier driver, so nothing is done"
    ]
    assert control.take(folder) == []


def test_who_may_send_requests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(tmp_path)
    assert control.allowed(folder) == "no driver is at work on the run"
    with pytest.raises(InputError, match="no driver"):
        control.send(folder, Action.STOP)
    with lock.hold(folder.lock):
        assert control.allowed(folder) == "its driver takes no requests yet"
        control.begin(folder)
        assert control.allowed(folder) is None
        monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser's rights are never too few
        assert "you may not write" in str(control.allowed(folder))


BLOCKS = tuple(BlockPlan(b, cameras=4, gaussians=100 + b, train=b != 2) for b in range(3))
PLANNED: list[Record] = [
    model(COARSE),
    ScoresSaved(TaskId.shard(0), "a", 1),
    PlanSaved("plan.json", BLOCKS),
]
STARTED = started(ZERO)
FAILED_FOR_GOOD = TaskFailed(ZERO, 3, "NaN", final=True)


def planned(*records: Record) -> RunState:
    return after(*PLANNED, *records)


def status(*records: Record) -> str:
    return planned(*records).status(ZERO)


def test_a_paused_block_waits_until_it_is_let_go() -> None:
    assert status(PauseRequested(ZERO)) == Status.PAUSED
    assert status(PauseRequested(ZERO), UnpauseRequested(ZERO)) == Status.WAITING
    assert status(STARTED, PauseRequested(ZERO)) == Status.RUNNING
    assert status(STARTED, PauseRequested(ZERO), TaskYielded(ZERO)) == Status.PAUSED
    assert status(STARTED, PauseRequested(ZERO), TaskYielded(ZERO), UnpauseRequested(ZERO)) == Status.WAITING
    assert status(STARTED, PauseRequested(ZERO), UnpauseRequested(ZERO), TaskYielded(ZERO)) == Status.WAITING
    lost = TaskFailed(ZERO, 1, "gone", final=False, kind=Failure.LOST)
    assert status(STARTED, PauseRequested(ZERO), lost) == Status.PAUSED
    done = planned(STARTED, PauseRequested(ZERO), model(ZERO))  # before it has heard of it
    assert (done.status(ZERO), done.held_blocks()) == (Status.DONE, ())


def test_a_pause_survives_the_driver() -> None:
    assert status(PauseRequested(ZERO), AGAIN) == Status.PAUSED
    assert status(STARTED, PauseRequested(ZERO), AGAIN) == Status.PAUSED
    shown = summarize(planned(STARTED, PauseRequested(ZERO)), running=False)
    assert shown.paused == (0,)
    assert {task.name: task.status for task in shown.tasks}[str(ZERO)] == Status.PAUSED


def test_a_retry_gives_all_attempts_again() -> None:
    state = planned(FAILED_FOR_GOOD, RetryRequested(ZERO))
    task = state.task(ZERO)
    assert (task.status, task.attempts, task.errors) == (Status.WAITING, 0, 0)
    assert task.reasons == ("NaN",)
    running = planned(TaskFailed(ZERO, 1, "NaN", final=False), STARTED, RetryRequested(ZERO)).task(ZERO)
    assert (running.status, running.errors) == (Status.RUNNING, 0)


def no(request: ControlRequest, *records: Record) -> str | None:
    return refusal(planned(*records), request)


def test_what_makes_no_sense_is_refused_with_a_reason() -> None:
    assert refusal(RunState(), ControlRequest(Action.STOP)) is None
    assert refusal(RunState(), ControlRequest(Action.PAUSE, 0)) == "there are no blocks yet"
    assert [no(ControlRequest(Action.PAUSE, b)) for b in (0, 2, 9)] == [None] + [
        f"there is no block {b} to train" for b in (2, 9)
    ]
    assert no(ControlRequest(Action.PAUSE, 0), PauseRequested(ZERO)) == "it is paused"
    assert no(ControlRequest(Action.PAUSE, 0), model(ZERO)) == "it is done"
    assert no(ControlRequest(Action.PAUSE, 0), FAILED_FOR_GOOD) == "it is failed"
    assert no(ControlRequest(Action.UNPAUSE, 0)) == "it is not paused"
    assert no(ControlRequest(Action.UNPAUSE, 0), STARTED, PauseRequested(ZERO)) is None
    assert no(ControlRequest(Action.RETRY, 0), STARTED) == "it has not failed"
    assert no(ControlRequest(Action.RETRY, 0), FAILED_FOR_GOOD) is None
    assert no(ControlRequest(Action.RETRY, 0), TaskFailed(ZERO, 1, "NaN", final=False)) is None
    merged = Merged("point_cloud.ply", 1, 0, 1, 1.0)
    assert "resume the run after its end" in str(no(ControlRequest(Action.RETRY, 0), FAILED_FOR_GOOD, merged))


def test_a_machine_in_quarantine_is_released_by_its_host_or_the_begin_of_its_id() -> None:
    bad: list[Record] = [NodeQuarantined(id, id[:3], "3 tasks have failed", 99.0) for id in ("aaa1", "aab2")]
    by_host, by_id = (ControlRequest(Action.RELEASE, node=node) for node in ("aaa", "aab2"))
    said = [NodeReleased("aaa1", "aaa", "a user has released it")]
    assert (
        answer(planned(*bad), by_host) == answer(planned(*bad, NodeReleased("aab2", "aab")), by_host) == said
    )
    assert answer(planned(*bad), by_id) == [NodeReleased("aab2", "aab", "a user has released it")]
    assert [node.id for node in planned(*bad, *said).quarantined()] == ["aab2"]
    ambiguous, unknown = (ControlRequest(Action.RELEASE, node=node) for node in ("aa", "b"))
    assert no(ambiguous, *bad) == "that is more than one machine: aaa, aab"
    assert no(unknown, *bad) == "no such machine is in quarantine; those are aaa, aab"
    assert no(unknown) == "no such machine is in quarantine; none is"


class Listening(Harness):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        control.begin(self.folder)
        self.yielded: list[TaskId] = []

    def send(self, action: str, block: int | None = None) -> None:
        with lock.hold(self.folder.lock):
            control.send(self.folder, action, block)

    def trains(self, spec: TaskSpec, iterations: int = 50) -> Iterator[Event]:
        for i in range(iterations if spec.task.stage is Stage.BLOCK else 0):
            yield Progress(spec.task, i, iterations, 1.0)
            if spec.task in self.pool.stopped:
                self.yielded.append(spec.task)
                yield Checkpoint(spec.task, i, {"iteration": torch.tensor(i)})
                return
        yield from well(spec)


@pytest.fixture
def listening(tmp_path: Path) -> Listening:
    return Listening(tmp_path)


def when_others_are_done(harness: Listening, action: str, block: int) -> None:
    """Sends a request as soon as the driver waits although nothing runs."""

    def once() -> None:
        harness.pool.when_waiting(lambda: None)
        harness.send(action, block)

    harness.pool.when_waiting(once)


@pytest.mark.parametrize("dies", [False, True])
def test_a_block_is_paused_and_unpaused(listening: Listening, dies: bool) -> None:
    """If it dies meanwhile, its failure counts, but it is not started again until a user requests it."""

    def pause() -> None:
        listening.send(Action.PAUSE, 1)
        when_others_are_done(listening, Action.UNPAUSE, 1)

    steps = pause, Progress(ONE, 1, 2, 1.0), *([CrashError(DIED)] if dies else [])
    assert listening.drive(begins(ONE, *steps, rest=listening.trains)).outcome == "done"
    assert listening.yielded == ([] if dies else [ONE])
    assert listening.tasks[-2:] == [ONE, EVAL]
    checkpoint = CheckpointFile(listening.folder.checkpoint(ONE))
    assert [spec.checkpoint for spec in listening.trainings(ONE)] == [None, None if dies else checkpoint]
    task = listening.state.task(ONE)
    assert (task.retries, task.reasons, task.held) == (dies, (DIED.reason,) * dies, False)
    assert [record.reason for record in listening.records(RunWaiting)] == ["waiting: block 1 is paused"]
    assert len(listening.records(RunContinued)) == 1 and listening.state.waiting == ""


def test_a_failed_block_is_retried_while_another_trains(listening: Listening) -> None:
    def last_failure() -> None:
        listening.send(Action.PAUSE, 0)  # so that there is still time
        when_others_are_done(listening, Action.RETRY, 1)

    fourth = begins(ONE, lambda: listening.send(Action.UNPAUSE, 0), rest=listening.trains)
    third = begins(ONE, last_failure, CrashError(DIED), rest=fourth)
    assert listening.drive(begins(ONE, CrashError(DIED), times=2, rest=third)).outcome == "done"
    assert listening.tasks.count(ONE) == 4
    assert listening.records(RetryRequested) == [RetryRequested(ONE)]


def test_stop_is_a_remote_ctrl_c_and_what_cannot_be_done_is_said(listening: Listening) -> None:
    def ask() -> None:
        listening.send(Action.RETRY, 0)
        put(listening.folder, "2.json", b'{"action": "rm"}')

    stop = begins(ONE, lambda: listening.send(Action.STOP), rest=listening.trains)
    with pytest.raises(KeyboardInterrupt):
        listening.drive(begins(COARSE, ask, rest=stop))
    assert sorted(listening.yielded) == [ZERO, ONE]
    state = listening.state
    assert [state.outcome, state.status(ZERO), state.status(ONE)] == [
        "interrupted",
        *[Status.WAITING] * 2,
    ]
    assert [notice.message for notice in state.notices if notice.task == Part.CONTROL] == [
        "retry block 0: there are no blocks yet",
        "control/'2.json' is not a request: 'rm' is none of stop, pause, unpause, retry, release",
    ]
    assert listening.drive(listening.trains, resumed=True).outcome == "done"
