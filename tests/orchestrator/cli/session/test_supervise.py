"""The supervisor: when it resumes a run, how often, what it passes on. Its drivers here follow a script."""

import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.cli.session import supervise
from panolog.orchestrator.cli.session.supervise import Supervised, cause
from panolog.orchestrator.runs import control, lock
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Outcome, RunBegan
from panolog.orchestrator.runs.state import RunState, ignore
from tests.orchestrator.cli.program import call, one_line
from tests.ray_head import wait_until

# A driver that records its beginning, perhaps a checkpoint and its end, and then ends as its line says.
DRIVER = """
import os, sys
from pathlib import Path
from panolog.orchestrator.runs.records import CheckpointSaved, Outcome, RunBegan, RunEnded
from panolog.orchestrator.runs.database import Database
from panolog.workers.tasks import COARSE

root, number = Path({root!r}), len(Path({log!r}).read_text().splitlines())
with Path({log!r}).open("a") as log:
    print(*sys.argv[1:], file=log)
word, _, value = {lines!r}[number].partition(" ")
if word != "refused":
    root.mkdir(exist_ok=True)
    (root / "run.json").touch()
if word not in ("refused", "early"):
    database = Database(root / "run.db")
    database.append([RunBegan("host", os.getpid(), number > 0)])
    if word == "saves":
        database.append([CheckpointSaved(COARSE, number, "", 1)])
    if word == "fails":
        database.append([RunEnded(Outcome.FAILED, "the run is wrong")])
    if word == "done":
        database.append([RunEnded(Outcome.DONE)])
    if word == "lost":
        database.append([RunEnded(Outcome.FAILED, "Ray is lost", transient=True)])
code = int(value)
os.kill(os.getpid(), -code) if code < 0 else os._exit(code)
"""


class Script:
    """A supervised run whose drivers do what one line each says."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root, self._log = folder / "run", folder / "drivers"
        self._log.touch()
        self.said: list[str] = []
        self.when_said: Callable[[str], None] = ignore
        self._monkeypatch = monkeypatch
        monkeypatch.setattr(supervise, "_FIRST_S", 0.0)

    def run(self, *lines: str, limit: int = 3, address: str | None = None) -> int:
        text = DRIVER.format(root=str(self.root), log=str(self._log), lines=lines)
        self._monkeypatch.setattr(supervise, "_PROGRAM", (sys.executable, "-c", text))
        first, options, limits = ["run", "scene", "-o", "run"], ["--nice", "3"], ["--max-cost", "5.0"]
        return supervise.supervise(Supervised(self.root, first, options, limits, address, limit, self._say))

    def _say(self, line: str) -> None:
        self.said.append(line)
        self.when_said(line)

    @property
    def drivers(self) -> list[str]:
        """The arguments of each."""
        return self._log.read_text().splitlines()


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Script:
    return Script(tmp_path, monkeypatch)


def state(pid: int = 7, outcome: Outcome | None = None, *, transient: bool = False) -> RunState:
    return RunState(driver=RunBegan("host", pid, False), outcome=outcome, reason="why", transient=transient)


@pytest.mark.parametrize(
    ("code", "after", "expected"),
    [
        (-9, state(), "killed by signal 9 (SIGKILL)"),
        (-6, RunState(), "killed by signal 6 (SIGABRT)"),
        (1, state(), "exit code 1 without a record, as when Ray has lost the head of its cluster"),
        (1, state(outcome=Outcome.FAILED, transient=True), "why"),
        (2, state(outcome=Outcome.FAILED, transient=True), "why"),
        (1, state(outcome=Outcome.FAILED), None),  # such as a block that has failed for good
        (2, state(outcome=Outcome.FAILED), None),
        (1, state(pid=8, outcome=Outcome.FAILED, transient=True), None),  # it was refused
        (2, RunState(), None),
        (130, state(outcome=Outcome.INTERRUPTED), None),
        (0, state(outcome=Outcome.DONE), None),
    ],
)
def test_what_is_resumed(code: int, after: RunState, expected: str | None) -> None:
    own = after.driver is not None and after.driver.pid == 7
    assert cause(code, after, own=own) == expected


def test_a_run_is_resumed_until_it_is_done(script: Script) -> None:
    assert script.run("dies -9", "lost 1", "dies 1", "dies 0") == 0
    first, *others = script.drivers
    assert first == "run scene -o run"
    assert [other.partition("--resumed-after ")[2] for other in others] == [
        "killed by signal 9 (SIGKILL)",
        "Ray is lost",
        "exit code 1 without a record, as when Ray has lost the head of its cluster",
    ]
    assert all(other.startswith(f"resume {script.root} --nice 3 --resumed-after ") for other in others)
    assert script.said[0].endswith("(SIGKILL)); resume 1 of at most 3 without progress in 0 s")


def test_what_ends_a_driver_after_its_run_is_done_changes_nothing(script: Script) -> None:
    """Ray ends a process, with exit code 1, whose cluster's head is gone when it leaves that."""
    assert script.run("done 1") == 0
    assert len(script.drivers) == 1


def test_a_driver_that_died_before_its_run_folder_was_there_is_started_anew(script: Script) -> None:
    assert script.run("refused -9", "dies 0") == 0
    assert script.drivers == ["run scene -o run"] * 2


def test_limits_are_given_until_a_driver_has_recorded_them(script: Script) -> None:
    """One may be killed between run.json and its first record."""
    assert script.run("early -9", "saves -9", "ends 0") == 0
    _, second, third = script.drivers
    assert second.startswith("resume") and "--max-cost 5.0" in second
    assert third.startswith("resume") and "--max-cost" not in third


@pytest.mark.parametrize("end", ["fails 1", "refused 2"])
def test_what_another_driver_cannot_help_ends(script: Script, end: str) -> None:
    assert script.run(end) == int(end.split()[1])
    assert (len(script.drivers), script.said) == (1, [])


def test_the_limit_counts_resumes_without_progress(script: Script) -> None:
    assert script.run("dies -9", "saves -9", "dies -9", "saves -9", *["dies -9"] * 2, "lost 1", limit=2) == 1
    assert len(script.drivers) == 6
    assert script.said[-1].endswith(f"2 resumes made no progress: `panolog resume {script.root}` tries again")


def test_pauses_grow_until_there_is_progress(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(supervise, "_FIRST_S", 2.0)
    monkeypatch.setattr(supervise, "_LONGEST_S", 5.0)
    monkeypatch.setattr(supervise._Supervisor, "_wait", lambda _, seconds: pauses.append(seconds))
    assert script.run("dies -9", "dies -9", "dies -9", "saves -9", "dies 0") == 0
    assert pauses == [2, 4, 5, 2]


def test_the_head_of_the_cluster_gets_time_to_come_back(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise, "_HEAD_POLL_S", 0.01)
    with closing(socket.socket()) as head, closing(socket.socket()) as gone:
        # No other program has their ports, and they do not answer before they listen.
        for bound in (head, gone):
            bound.bind(("127.0.0.1", 0))
        address, other = (f"127.0.0.1:{bound.getsockname()[1]}" for bound in (head, gone))
        script.when_said = lambda line: head.listen() if address in line else None
        assert script.run("lost 1", "dies 0", address=address) == 0
        assert script.said[-1] == f"waiting at most 30:00 for the cluster at {address}"
        monkeypatch.setattr(supervise, "_HEAD_S", 0.1)
        monkeypatch.setenv("RAY_ADDRESS", other)
        assert script.run("", "", "lost 1", address="auto") == 1
    assert script.said[-1].startswith(f"the cluster at {other} does not answer: `panolog resume ")


SUPERVISOR = """
import signal, sys
from pathlib import Path
from panolog.orchestrator.cli.session import supervise

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it,
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and those of nohup this one
supervise._PROGRAM = (sys.executable, "-c", sys.argv[2])
supervise._FIRST_S = 600.0
say = lambda line: print(line, flush=True)
sys.exit(supervise.supervise(supervise.Supervised(Path(sys.argv[1]), [], [], [], None, 3, say)))
"""
WAITS = """
import os, signal, sys
signals = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
assert not signal.pthread_sigmask(signal.SIG_BLOCK, signals)
print(os.getpid(), flush=True)
print(signal.sigwait(signals).name, flush=True)
sys.exit(130)
"""


def launch(root: Path, driver: str) -> tuple[subprocess.Popen[str], str]:
    """A supervisor, and the first line that it or its driver has printed."""
    command = [sys.executable, "-c", SUPERVISOR, str(root), driver]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    return process, process.stdout.readline().strip()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_requests_to_stop_reach_the_driver(tmp_path: Path, number: signal.Signals) -> None:
    process, _ = launch(tmp_path, WAITS)
    process.send_signal(number)
    assert process.communicate(timeout=300)[0].split() == [number.name]
    assert process.returncode == 130


def test_a_stop_between_two_drivers(tmp_path: Path) -> None:
    process, said = launch(tmp_path, "import os; os.kill(os.getpid(), 9)")
    assert said.endswith("resume 1 of at most 3 without progress in 300 s")
    process.terminate()
    assert process.communicate(timeout=300)[0].split()[0] == "stopped;"
    assert process.returncode == 130


def test_panolog_stop_between_two_drivers(tmp_path: Path) -> None:
    """`panolog stop` between two drivers was refused, and then the run was resumed."""
    folder = RunFolder(tmp_path)
    folder.info.write_text('{"scene": {"path": "scene"}, "config": {"width": 64}}')
    Database(folder.database).close()
    control.begin(folder)
    process, _ = launch(tmp_path, "import os; os.kill(os.getpid(), 9)")
    wait_until(lambda: lock.held(folder.supervisor), "its pause")
    assert call("stop", tmp_path).exit_code == 0
    assert process.communicate(timeout=300)[0].split()[0] == "stopped;"
    assert process.returncode == 130
    assert "no driver is at work" in one_line(call("stop", tmp_path))


def test_a_supervisor_that_is_killed_stops_its_driver(tmp_path: Path) -> None:
    process, _ = launch(tmp_path, WAITS)
    process.kill()
    assert process.communicate(timeout=300)[0].split() == ["SIGTERM"]  # the end of the driver's output


def test_a_limit_needs_a_supervisor(tmp_path: Path) -> None:
    said = one_line(call("run", "scene", "-o", tmp_path / "run", "--max-resumes", 3))
    assert said == "panolog: --max-resumes 3: only with --supervise, which resumes; add it"
