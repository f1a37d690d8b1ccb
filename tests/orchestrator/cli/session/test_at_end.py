"""`--at-end`: when its command is carried out, and what its environment has."""

import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.cli.session import at_end, supervise
from panolog.orchestrator.cli.session.at_end import when_ended
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.money.records import BudgetReached, BudgetSet
from panolog.orchestrator.runs.records import Outcome, Record, RunBegan, RunEnded
from panolog.orchestrator.runs.storage.state import MirrorState, write_state
from panolog.orchestrator.runs.store import Database
from tests.orchestrator.cli.program import begun, call

URL = "s3://bucket/run"
BEGAN = RunBegan("host", 7, resumed=False)
DONE = (BEGAN, RunEnded(Outcome.DONE))
LIMITED = (BEGAN, BudgetSet(deadline=5.0), BudgetReached("the limit of 5 USD"), RunEnded(Outcome.LIMITED))
FAILED = (BEGAN, RunEnded(Outcome.FAILED, "block 3 has failed"))


def run_of(root: Path, *records: Record) -> RunFolder:
    """A run with that history, of a scene that is gone."""
    folder = begun(root)
    with closing(Database(folder.database)) as database:
        database.append(records)
    return folder


class End:
    """A command that leaves what its environment has."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "said"
        words = "$PANOLOG_OUTCOME|$PANOLOG_REASON|$PANOLOG_RUN"
        self.option = ("--at-end", f'echo "{words}" >> {self._file}')

    @property
    def said(self) -> list[list[str]]:
        """Outcome, reason and run of each time."""
        lines = self._file.read_text().splitlines() if self._file.exists() else []
        return [line.split("|") for line in lines]


@pytest.fixture
def end(tmp_path: Path) -> End:
    return End(tmp_path)


def drive(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Lets a supervisor run drivers that are these lines of Python."""
    monkeypatch.setattr(supervise, "_PROGRAM", (sys.executable, "-c", program))


@pytest.mark.parametrize(("records", "outcome"), [(DONE, "done|"), (LIMITED, "limited|the limit of 5 USD")])
def test_it_follows_the_end_of_a_run(
    tmp_path: Path, end: End, records: tuple[Record, ...], outcome: str
) -> None:
    folder = run_of(tmp_path / "run", *records)
    result = call("resume", folder.root, *end.option)
    assert result.exit_code == 0, result.output
    assert end.said == [[*outcome.split("|"), str(folder.root)]]
    assert "carrying out --at-end: echo" in result.stderr


def test_a_run_that_fails_or_is_refused_is_told_apart(tmp_path: Path, end: End) -> None:
    """The scene is gone, so neither can be resumed."""
    for name, records, outcome in (("a", FAILED, "failed"), ("b", (BEGAN,), "refused")):
        folder = run_of(tmp_path / name, *records)
        assert call("resume", folder.root, *end.option).exit_code == 2
        (found, reason, run) = end.said[-1]
        assert (found, run) == (outcome, str(folder.root)) and "/gone" in reason


def test_a_run_that_is_refused_before_there_is_a_folder(tmp_path: Path, end: End) -> None:
    root = tmp_path / "new"
    assert call("run", tmp_path / "nowhere", "-o", root, *end.option).exit_code == 2
    ((outcome, reason, run),) = end.said
    assert (outcome, run) == ("refused", str(root)) and "nowhere" in reason and not root.exists()


def test_a_supervisor_carries_it_out_once_when_it_gives_up(
    tmp_path: Path, end: End, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run_of(tmp_path / "run", BEGAN)
    monkeypatch.setattr(supervise, "_FIRST_S", 0.0)
    drive(monkeypatch, "import os; os.kill(os.getpid(), 9)")
    assert call("resume", folder.root, "--supervise", "--max-resumes", 2, *end.option).exit_code == 1
    assert end.said == [["failed", "exit code 1", str(folder.root)]]


@pytest.mark.parametrize(
    ("code", "said"), [(0, ["done"]), (1, ["failed"]), (2, ["refused"]), (130, [])], ids=str
)
def test_a_supervisor_carries_it_out_unless_its_driver_was_stopped(
    tmp_path: Path, end: End, monkeypatch: pytest.MonkeyPatch, code: int, said: list[str]
) -> None:
    folder = run_of(tmp_path / "run", BEGAN)
    drive(monkeypatch, f"import sys; sys.exit({code})")
    assert call("resume", folder.root, "--supervise", *end.option).exit_code == code
    assert [outcome for outcome, *_ in end.said] == said


def test_another_driver_keeps_its_machine(tmp_path: Path, end: End) -> None:
    folder = run_of(tmp_path / "run", BEGAN)
    with lock.hold(folder.lock):
        result = call("resume", folder.root, *end.option)
    assert result.exit_code == 2 and end.said == []
    assert "another driver is at work" in result.stderr


def test_a_run_that_is_not_all_in_its_store_keeps_its_machine(tmp_path: Path, end: End) -> None:
    folder = run_of(tmp_path / "run", *DONE)
    said: list[str] = []
    for state, count in ((MirrorState(URL, problem="no access"), 0), (MirrorState(URL, complete=True), 1)):
        write_state(folder.mirror, state)
        with when_ended(end.option[1], said.append) as own:
            own(folder.root)
        assert len(end.said) == count
    assert said[0].endswith(f"for nothing to be lost: nothing is in {URL} yet; no access")


def test_a_command_that_fails_or_hangs_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, file = run_of(tmp_path / "run", *DONE), tmp_path / "goes on"
    result = call("resume", folder.root, "--at-end", "exit 3")
    assert (result.exit_code, "has failed (code 3)" in result.stderr) == (0, True)
    started: list[subprocess.Popen[bytes]] = []

    def start(*words: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(subprocess.Popen(*words, **options))
        return started[-1]

    monkeypatch.setattr(at_end, "Popen", start)
    monkeypatch.setattr(at_end, "_LONGEST_S", 0.05)
    waits = f"while [ ! -e '{file}' ]; do sleep 0.02; done; exit 7"
    result = call("resume", folder.root, "--at-end", waits)
    assert "it goes on by itself" in result.stderr
    file.touch()
    assert started[0].wait(timeout=300) == 7
