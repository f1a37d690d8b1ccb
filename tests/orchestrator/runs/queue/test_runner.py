"""The runner: order, limits, ends of every kind; nothing is lost or doubled when processes are killed."""

import os
import random
import signal
import subprocess
import sys
from collections import Counter
from contextlib import closing, suppress
from functools import partial
from pathlib import Path

import pytest

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.queue import processes
from panolog.orchestrator.runs.queue.database import Queue
from panolog.orchestrator.runs.queue.entries import State
from panolog.orchestrator.runs.queue.runner import log_of
from panolog.orchestrator.runs.queue.view import remove_entry, view_queue
from panolog.scene.errors import QueueError
from tests.orchestrator.runs.queue.queues import RUNNER, Scripted
from tests.orchestrator.runs.queue.stand_in import STEPS
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

RESULT = "\n".join(str(step + 1) for step in range(STEPS))


def ended(runner: "subprocess.Popen[str]") -> tuple[int, list[str]]:
    output, _ = runner.communicate(timeout=480)
    return runner.returncode, output.splitlines()


def test_every_end_has_its_state_and_reason_and_the_next_run_starts(tmp_path: Path) -> None:
    queue = Scripted(tmp_path)
    queue.add("wrong", "refused")
    queue.add("killed", "fragile")
    queue.add("stopped")
    (tmp_path / "stopped").mkdir()
    (tmp_path / "stopped" / "stop").touch()
    queue.add("good")
    code, said = ended(queue.start())
    assert code == 1
    entries = {entry.command.run.name: entry for entry in queue.entries()}
    assert [entries[name].state for name in ("wrong", "killed", "stopped", "good")] == [
        State.FAILED,
        State.DONE,  # only its first attempt kills itself: it is resumed
        State.STOPPED,
        State.DONE,
    ]
    assert (entries["wrong"].code, entries["stopped"].code) == (2, 130)
    assert entries["wrong"].reason == "refused: there is no such scene; give another one"
    assert entries["stopped"].reason == "stopped by a user; `panolog queue retry 3` resumes it"
    assert "2: its process was killed by signal 9; it is resumed" in said
    assert "refused" in log_of(queue.folder, 1).read_text()
    (tmp_path / "stopped" / "stop").unlink()
    with closing(Queue(queue.folder)) as opened:
        opened.retry(3)
    assert ended(queue.start())[0] == 0
    assert queue.lines()[-2][0] == "resumes"
    assert queue.states() == [State.FAILED, State.DONE, State.DONE, State.DONE]


def test_a_run_that_is_killed_again_and_again_has_failed(tmp_path: Path) -> None:
    queue = Scripted(tmp_path)
    queue.add("a", held=True)
    runner = queue.start()
    for count in range(1, 6):
        wait_until(partial(_attempts, queue, count), "the next attempt")
        os.kill(int(queue.lines()[-1][2]), signal.SIGKILL)
    assert ended(runner)[0] == 1
    (entry,) = queue.entries()
    assert (entry.state, entry.losses, entry.starts) == (State.FAILED, 5, 5)
    assert entry.reason.startswith("its process was killed 5 times in a row by signal 9; ")


def test_a_stop_reaches_the_runs_and_the_next_runner_resumes_them_first(tmp_path: Path) -> None:
    queue = Scripted(tmp_path, at_once=2)
    for name in ("a", "b", "c"):
        queue.add(name, held=True)
    runner = queue.start()
    wait_until(lambda: len(queue.lines()) == 2, "two runs at work, as many as are allowed")
    runner.send_signal(signal.SIGINT)
    code, said = ended(runner)
    assert code == 130
    assert "stopping: the runs save checkpoints" in said[2]
    assert queue.states() == [State.RUNNING, State.RUNNING, State.WAITING]
    with closing(Queue(queue.folder)) as opened:
        assert [view_queue(opened).label(entry) for entry in opened.entries()] == [
            "interrupted",
            "interrupted",
            "waiting",
        ]
    for name in ("a", "b", "c"):
        (tmp_path / name / "wait").unlink()
    queue.at_once = 1
    assert ended(queue.start())[0] == 0
    words = [f"{word} {run}" for word, run, _ in queue.lines()]
    assert words[4:] == ["resumes a", "done a", "resumes b", "done b", "begins c", "done c"]


def test_a_runner_that_waits_takes_new_entries_and_is_the_only_one(tmp_path: Path) -> None:
    queue = Scripted(tmp_path, forever=True)
    queue.add("a")
    runner = queue.start()
    wait_until(lambda: queue.states() == [State.DONE], "the first run")
    queue.add("b")
    wait_until(lambda: queue.states() == [State.DONE] * 2, "the second run")
    code, said = ended(queue.start())
    assert code == 1
    assert said[-1].endswith(
        "another `panolog queue run` is at work on this queue; it takes new entries by itself"
    )
    runner.terminate()
    assert ended(runner)[0] == 130


def test_a_runner_that_is_killed_at_the_gate_has_begun_nothing(tmp_path: Path) -> None:
    """Between the start of a child and the note of its identity."""
    queue = Scripted(tmp_path)
    queue.add("a")
    code = (
        "import os, signal; from panolog.orchestrator.runs.queue.database import Queue;"
        "Queue.launched = lambda *_: os.kill(os.getpid(), signal.SIGKILL);"
    )
    program = (sys.executable, "-S", str(Path(__file__).with_name("stand_in.py")), str(queue.log))
    boot = tmp_path / "boot_id"
    boot.write_text("boot-0\n")
    killed = subprocess.run(
        [sys.executable, "-c", code + RUNNER, str(queue.folder), str(boot), "1", "0", *program], check=False
    )
    assert killed.returncode == -signal.SIGKILL
    (entry,) = queue.entries()
    assert (entry.state, entry.starts, entry.process) == (State.RUNNING, 0, None)
    assert ended(queue.start())[0] == 0
    assert [word for word, _, _ in queue.lines()] == ["begins", "done"]


def test_what_ran_while_no_runner_was_there_is_removed_only_if_it_is_dead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = Scripted(tmp_path)
    queue.add("a", held=True)
    runner = queue.start()
    wait_until(lambda: len(queue.lines()) == 1, "the run")
    monkeypatch.setattr(processes, "BOOT", tmp_path / "boot_id")
    with closing(Queue(queue.folder)) as opened:
        with pytest.raises(QueueError, match="entry 1 is running; stop it first: `panolog stop "):
            remove_entry(opened, 1)
        queue.reboot(runner)
        wait_until(lambda: not lock.held(tmp_path / "a" / "lock"), "the end of its locks")
        remove_entry(opened, 1)
    assert queue.states() == [State.REMOVED]


def test_another_process_of_the_same_number_is_not_taken_for_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot = tmp_path / "boot"
    boot.write_text("one\n")
    monkeypatch.setattr(processes, "BOOT", boot)
    me = processes.identity(os.getpid())
    assert processes.alive(me)
    later = type(me)(me.boot, me.pid, me.started + 1)
    assert not processes.alive(later)
    boot.write_text("two\n")
    assert not processes.alive(me)
    child = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and is not waited for
    with pytest.raises(ProcessLookupError):
        processes.identity(child.pid)
    child.wait()


@pytest.mark.parametrize("at_once", [1, 3])
def test_many_runs_with_kills_and_reboots(tmp_path: Path, at_once: int) -> None:
    """Order and results are right, none is lost and none is run twice."""
    queue, chance = Scripted(tmp_path, at_once), random.Random(at_once)
    names = [f"run-{number:02d}" for number in range(24)]
    for name in names:
        queue.add(name)
    runner, kills = queue.start(), Counter[str]()
    while not all(_is_done(tmp_path / name) for name in names):
        mark = len(queue.lines()) + chance.randrange(3, 7)
        wait_until(partial(_has_worked, queue, runner, mark), "more work", seconds=300)
        if runner.poll() is not None:
            break
        kind = ("runner", "run", "reboot")[kills.total() % 3]
        kills[kind] += 1
        if kind == "run":
            word, _, pid = queue.lines()[-1]
            if word in ("begins", "resumes"):
                with suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            continue
        if kind == "runner":
            runner.kill()
            runner.wait()
        else:
            queue.reboot(runner)
        runner = queue.start()
    code, said = ended(runner)
    assert code == 0, said
    assert min(kills.values()) >= 2, kills
    assert queue.states() == [State.DONE] * len(names)
    lines = queue.lines()
    assert all(_is_done(tmp_path / name) for name in names)
    assert not [line for line in lines if line[0] == "locked-out"]
    starts = [run for word, run, _ in lines if word in ("begins", "resumes")]
    firsts = list(dict.fromkeys(starts))
    assert sorted(firsts) == names
    if at_once == 1:
        assert firsts == names
        assert [run for run, before in zip(starts, ["", *starts], strict=False) if run != before] == names


def _has_worked(queue: Scripted, runner: "subprocess.Popen[str]", mark: int) -> bool:
    return len(queue.lines()) >= mark or runner.poll() is not None


def _attempts(queue: Scripted, count: int) -> bool:
    return len(queue.lines()) == count


def _is_done(run: Path) -> bool:
    steps = run / "steps"
    return steps.exists() and steps.read_text() == RESULT
