"""The follower as a process: what it delivers when a run ends or is killed, or it is killed itself."""

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.cli.session.companion import companion_follower
from panolog.orchestrator.runs import lock
from panolog.orchestrator.watch.follower.follower import Follower
from panolog.orchestrator.watch.follower.recipients import Recipients, SinkChoice
from panolog.orchestrator.watch.follower.targets import Target
from panolog.orchestrator.watch.follower.watcher import Watcher
from tests.orchestrator.watch.follower import histories
from tests.orchestrator.watch.follower.receivers import Receiver, receiver
from tests.ray_head import living, wait_until

pytestmark = pytest.mark.system

FOLLOWER = "panolog.orchestrator.watch.follower"
# Its parent has closed the pipe, and has the lock of the run until it is killed.
DYING = """
import os, signal, subprocess, sys
from pathlib import Path
from panolog.orchestrator.watch.follower.recipients import read_recipients, to_json
from panolog.orchestrator.runs import lock

root = Path(sys.argv[1])
plan, _ = read_recipients(["webhook:env:HOOK"], (), {"HOOK": sys.argv[2], "HOME": "/nowhere"})
with lock.hold(root / "lock"):
    command = [sys.executable, "-m", "panolog.orchestrator.watch.follower"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE)
    process.stdin.write((to_json(plan, root) + "\\n").encode())
    process.stdin.close()
    signal.pause()
"""


def plan_of(server: Receiver, *more: Target) -> Recipients:
    return Recipients((Target("webhook", "hook", f"{server.url}/x", secret="s"), *more))


def follower_of(parent: int) -> psutil.Process:
    """The follower of a process; until it executes its program it has the command line of its parent."""
    wait_until(lambda: living(FOLLOWER, parent), "a follower")
    (process,) = living(FOLLOWER, parent)
    return process


def gone(process: psutil.Process) -> bool:
    """Whether it has ended, also where its parent has not reaped it yet."""
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_the_end_of_a_run_is_delivered_once_over_several_commands(tmp_path: Path) -> None:
    said: list[str] = []
    with receiver() as server:
        for number in range(3):
            with companion_follower(tmp_path / "run", plan_of(server), said.append):
                histories.write(tmp_path / "run", number, number + 1)
        with companion_follower(tmp_path / "run", plan_of(server), said.append):
            pass  # as `resume` of a run that is done
    assert server.texts == ["run.failed", "run.failed", "run.done"]  # two drivers were killed
    assert len({it.json["id"] for it in server.received}) == 3
    assert said == []


def test_drivers_that_a_supervisor_replaces_are_no_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, look, ended = list[None](), Watcher.look, threading.Event()

    def counted(watcher: Watcher) -> bool:
        found = look(watcher)
        looks.append(None)
        return found

    monkeypatch.setattr(Watcher, "look", counted)
    monkeypatch.setattr("panolog.orchestrator.watch.follower.follower.POLL_S", 0.05)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    with receiver() as server, ThreadPoolExecutor(1) as threads:
        follower = Follower(tmp_path / "run", os.getppid(), plan_of(server))
        problems = threads.submit(follower.follow, ended)
        try:
            for number in range(3):
                histories.write(tmp_path / "run", number, number + 1)
                looks.clear()
                wait_until(lambda: len(looks) >= 2, "a look that begins after all was written")
        finally:
            ended.set()
        assert problems.result(120) == []
    assert server.texts == ["run.done"]


def test_nothing_is_delivered_while_another_driver_is_at_work(tmp_path: Path) -> None:
    folder = histories.write(tmp_path / "run")
    with (
        receiver() as server,
        lock.hold(folder.lock),
        companion_follower(folder.root, plan_of(server), print),
    ):
        pass
    assert server.received == []


def test_a_follower_that_was_killed_is_replaced_at_the_end(tmp_path: Path) -> None:
    with receiver() as server:
        with companion_follower(tmp_path / "run", plan_of(server), print):
            histories.write(tmp_path / "run")
            follower_of(os.getpid()).kill()  # and the context ends, perhaps before it is gone
        assert server.texts == ["run.done"]


def test_a_killed_command_that_closes_its_pipe_before_its_lock_has_failed(tmp_path: Path) -> None:
    folder = histories.write(tmp_path / "run", 0, 1)
    with receiver() as server:
        run = subprocess.Popen([sys.executable, "-c", DYING, str(folder.root), f"{server.url}/x"])
        process = follower_of(run.pid)
        wait_until(lambda: list(folder.follower.glob("webhook-*")), "a look after the end of its stdin")
        run.kill()
        run.wait()
        wait_until(lambda: gone(process), "the end of its follower")
    assert server.texts == ["run.failed"]
    assert "killed" in server.received[0].json["text"]


def test_signals_that_end_a_run_do_not_end_its_follower(tmp_path: Path) -> None:
    with receiver() as server:
        with companion_follower(tmp_path / "run", plan_of(server), print):
            process = follower_of(os.getpid())
            histories.write(tmp_path / "run")
            wait_until(lambda: _ignores(process.pid, signal.SIGHUP), "it ignores signals")
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                process.send_signal(number)
        assert server.texts == ["run.done"]


def _ignores(pid: int, number: int) -> bool:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    mask = int(next(line for line in lines if line.startswith("SigIgn")).split()[1], 16)
    return bool(mask >> (number - 1) & 1)


def test_a_target_that_hangs_neither_holds_up_the_others_nor_the_run_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    monkeypatch.setattr("panolog.orchestrator.watch.follower.follower.LAST_S", 1.0)
    folder, ended = histories.write(tmp_path / "run"), threading.Event()
    ended.set()
    with receiver(hangs=True) as hung:
        plan = Recipients((Target("webhook", "hung", hung.url),))
        Follower(folder.root, os.getppid(), plan).follow(ended)
        assert not hung.hang.is_set()  # its end was not waited for
        hung.hang.set()
        for courier in [it for it in threading.enumerate() if it.name == "hung"]:
            courier.join(120)
    monkeypatch.setattr("panolog.orchestrator.watch.follower.follower.LAST_S", 120.0)
    with receiver() as server, receiver(hangs=True) as hung, ThreadPoolExecutor(1) as threads:
        plan = plan_of(server, Target("webhook", "hung", hung.url))
        problems = threads.submit(Follower(folder.root, os.getppid(), plan).follow, ended)
        try:
            wait_until(lambda: server.texts == ["run.done"], "the news at the other target")
            assert not hung.hang.is_set()
        finally:
            hung.hang.set()
        assert problems.result(240) == []


@pytest.mark.parametrize(("does", "code"), [("sleep 1000", -9), ("false", 1)])
def test_a_follower_that_does_not_end_or_cannot_work_is_said_and_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: str, code: int
) -> None:
    program, said = tmp_path / "python", list[str]()
    program.write_text(f"#!/bin/sh\nexec {does}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    if code < 0:
        monkeypatch.setattr("panolog.orchestrator.cli.session.companion._FOLLOWER_S", 0.1)
    with receiver() as server, companion_follower(tmp_path / "run", plan_of(server), said.append):
        pass
    assert said == [f"the follower has ended early (code {code}): not all may be delivered"]


def test_what_was_not_delivered_is_said_without_a_secret(tmp_path: Path) -> None:
    said: list[str] = []
    with receiver([404]) as server, companion_follower(tmp_path / "run", plan_of(server), said.append):
        histories.write(tmp_path / "run")
    assert said == ["notify hook: the server answers HTTP 404; not delivered: done"]


def test_an_error_that_nothing_foresees_ends_one_thread_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("T0PSECRET")

    monkeypatch.setattr("panolog.orchestrator.watch.follower.follower._made", broken)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    folder, ended = histories.write(tmp_path / "run"), threading.Event()
    ended.set()
    with receiver() as server:
        plan = Recipients(plan_of(server).targets, (SinkChoice("tensorboard"),))
        problems = Follower(folder.root, os.getppid(), plan).follow(ended)
    assert problems == ["log tensorboard: internal error: ValueError"]
    assert server.texts == ["run.done"]
