"""Tasks in plain processes: how they end, and how they are stopped."""

import os
import signal
from collections.abc import Iterator

import psutil
import pytest
import torch

from panolog.orchestrator.engine.driver.local_pool import LocalPool, local_pool
from panolog.orchestrator.engine.scheduling.pool import Ended, Failed, Hello, Message
from panolog.orchestrator.runs.machines.machine import oom_kills
from panolog.orchestrator.runs.machines.nodes import Placement
from panolog.orchestrator.runs.records import Failure
from panolog.workers.events import Checkpoint, Notice
from panolog.workers.specs import TaskSpec
from tests.orchestrator import scripted
from tests.orchestrator.scripted import TASK, Fails, HangsAtExit, SendsMuch, Short, Works

pytestmark = pytest.mark.system


@pytest.fixture
def pool() -> Iterator[LocalPool]:
    with local_pool() as pool:
        yield pool


def messages(pool: LocalPool, spec: TaskSpec) -> Iterator[Message]:
    return scripted.messages(pool, spec, Placement(pool.nodes()[0].id, cpus=1.0, memory=2**30))


def begun(pool: LocalPool, spec: TaskSpec) -> tuple[int, Iterator[Message]]:
    """The process of a task that has said Hello, and its other messages."""
    running = messages(pool, spec)
    hello = next(running)
    assert isinstance(hello, Hello)
    return hello.pid, running


@pytest.mark.parametrize(
    ("how", "reason"),
    [("read", "/nowhere/a.jpg: cannot be read (No such file or directory)"), ("bug", "ValueError: no")],
)
def test_a_failure_follows_what_was_sent_before_it(pool: LocalPool, how: str, reason: str) -> None:
    """The kinds of failures are those of scheduling/test_pool.py."""
    _, (notice, failed) = begun(pool, Fails(how=how))
    assert notice == Notice(TASK, how)
    assert isinstance(failed, Failed)
    assert (failed.kind, failed.reason, bool(failed.detail)) == (Failure.ERROR, reason, how == "bug")


@pytest.mark.parametrize(("kills", "kind"), [(0, Failure.LOST), (10**6, Failure.MEMORY)])
def test_a_killed_worker_is_lost_or_had_no_memory(
    pool: LocalPool, monkeypatch: pytest.MonkeyPatch, kills: int, kind: Failure
) -> None:
    counted = oom_kills() + kills
    monkeypatch.setattr("panolog.orchestrator.engine.driver.local_pool.oom_kills", lambda: counted)
    pid, running = begun(pool, Works())
    os.kill(pid, signal.SIGKILL)
    *_, failed = running
    assert isinstance(failed, Failed)
    assert failed.kind == kind


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_worker_looks_at_its_card_before_it_begins(pool: LocalPool) -> None:
    half = Placement(pool.nodes()[0].id, 1.0, 2**30, gpus=0.5)
    _, failed = scripted.messages(pool, Short(device="cuda"), half)
    assert isinstance(failed, Failed) and ("CUDA" in failed.reason or "NVIDIA" in failed.reason)


def test_a_task_that_is_stopped_yields_a_checkpoint_and_ends(pool: LocalPool) -> None:
    received = []
    for message in messages(pool, Works()):
        received.append(message)
        if len(received) == 5:
            pool.stop(TASK)
    assert [type(message) for message in received[-2:]] == [Checkpoint, Ended]
    assert len(received) > 5


def test_a_worker_that_hangs_is_cancelled(pool: LocalPool) -> None:
    pid, _ = begun(pool, Works())
    os.kill(pid, signal.SIGSTOP)
    pool.cancel(TASK)
    assert not psutil.pid_exists(pid)
    assert pool.ready(0.1) == []
    assert begun(pool, Works())


def test_a_worker_that_stops_within_a_message_is_lost(
    pool: LocalPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.orchestrator.engine.driver.local_pool._STALL_S", 1)
    monkeypatch.setattr("panolog.orchestrator.engine.driver.local_pool._EXIT_S", 1.0)
    pid, running = begun(pool, SendsMuch())
    assert pool.ready(60) == [TASK]  # its beginning: nothing reads the rest yet
    os.kill(pid, signal.SIGSTOP)
    assert next(running) == Failed("the worker stopped within a message for 1 s", Failure.LOST)
    assert pool.ready(0.1) == []


def test_a_process_that_does_not_end_is_killed(pool: LocalPool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("panolog.orchestrator.engine.driver.local_pool._EXIT_S", 1.0)
    pid, (_, ended) = begun(pool, HangsAtExit())
    assert isinstance(ended, Ended)
    assert not psutil.pid_exists(pid)
