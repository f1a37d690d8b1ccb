"""The commands that send requests to a run's driver, and their messages when no driver runs."""

import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

import pytest

from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.control import Action, ControlRequest
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.presence import Presence
from panolog.orchestrator.runs.records import BlockPlan, NodeQuarantined, PlanSaved, TaskFailed
from panolog.workers.tasks import TaskId
from tests.orchestrator.cli.program import call, one_line, shown
from tests.orchestrator.history import BEGAN, append, begun


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run with two blocks, of which the second has failed."""
    plan = PlanSaved("plan.json", tuple(BlockPlan(block, 4, 100, train=True) for block in (0, 1)))
    failed = TaskFailed(TaskId.block(1), 3, "NaN", final=True)
    return begun(tmp_path / "run", BEGAN, plan, failed)


@pytest.fixture
def driven(folder: RunFolder) -> Iterator[RunFolder]:
    """The same with a driver that listens."""
    with lock.hold(folder.lock):
        control.begin(folder)
        yield folder


def test_what_is_asked_reaches_the_driver(driven: RunFolder) -> None:
    assert call("pause", driven.root, 0).exit_code == 0
    retried = call("retry", driven.root, 1)
    assert (retried.exit_code, retried.stdout) == (0, "")
    assert control.take(driven) == [ControlRequest(Action.PAUSE, 0), ControlRequest(Action.RETRY, 1)]


def test_status_says_why_a_run_waits_where_its_database_takes_nothing(driven: RunFolder) -> None:
    assert shown("status", driven.root)["waiting"] == ""
    Presence(driven.presence).say("disk full, waiting: free 2.0 GiB or stop the run")
    found = shown("status", driven.root)
    assert (found["status"], found["label"]) == ("running", "waiting")
    assert found["waiting"].startswith("disk full, waiting: free 2.0 GiB")
    assert "disk full, waiting" in call("status", driven.root).stdout
    for damage in (b"", b"[]", b"{", b"\xff" * 2000):
        driven.presence.write_bytes(damage)
        assert shown("status", driven.root)["waiting"] == ""


def test_what_makes_no_sense_is_one_line(driven: RunFolder) -> None:
    """All reasons are in tests/orchestrator/runs/test_control.py, also those without a driver."""
    line = f"panolog: {driven.root}: pause block 1: it is failed"
    assert one_line(call("pause", driven.root, 1)) == line
    assert control.take(driven) == []


def test_a_machine_in_quarantine_is_shown_and_released(driven: RunFolder) -> None:
    until = time.time() + 228.5 * 3_600
    bad = NodeQuarantined("3f2a81c4d5", "gpu-07", "3 tasks have failed there in a row", until)
    append(driven, bad)
    text = call("status", driven.root).stdout
    assert "gpu-07 (3f2a81c4): in quarantine for another 228:" in " ".join(text.split())
    assert f"panolog release {driven.root} gpu-07" in text
    (node,), wanted = shown("status", driven.root)["quarantined"], ("node", "host", "reason", "until")
    assert node == {**{name: vars(bad)[name] for name in wanted}, "state": "quarantined"}
    assert call("release", driven.root, "gpu-07").exit_code == 0
    assert control.take(driven) == [ControlRequest(Action.RELEASE, node="gpu-07")]
    why = "release gpu-7: no such machine is in quarantine; those are gpu-07"
    assert one_line(call("release", driven.root, "gpu-7")) == f"panolog: {driven.root}: {why}"


def test_stop_waits_until_the_driver_has_gone(folder: RunFolder) -> None:
    listens, heard = Event(), list[object]()

    def drive() -> None:
        with lock.hold(folder.lock):
            control.begin(folder)
            listens.set()
            while not heard and not given_up.wait(0.02):
                heard.extend(control.take(folder))

    given_up, driver = Event(), Thread(target=drive)
    driver.start()
    try:
        assert listens.wait(120)
        stopped = call("stop", folder.root)
        assert (stopped.exit_code, heard) == (0, [ControlRequest(Action.STOP)])
        assert not lock.held(folder.lock)
        assert "`panolog resume" in stopped.stderr
    finally:
        given_up.set()
        driver.join()
