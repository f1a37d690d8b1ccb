"""Steps that fail, hang or are killed: each leaves its reason, and what was done before stays."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.first_hour import __main__ as program
from benchmarks.first_hour import supervise
from benchmarks.first_hour.outcome import Context
from benchmarks.first_hour.steps import STEPS, limit
from tests.ray_head import wait_until

Fake = Callable[[str], None]  # makes the process of each step run this code

PASSES = "context.save(Outcome('passed', '7 ms'))"
HANGS = """
context.save(Outcome('passed', '3 of 9 rows'))
print('block 1 of 2', flush=True)
child = subprocess.Popen(['sleep', '6000'])
Path(context.work, 'made').write_text(str(child.pid))
Path(context.work, 'made').rename(Path(context.work, 'pid'))
"""
IGNORES = f"signal.signal(signal.SIGTERM, signal.SIG_IGN){HANGS}while True: signal.pause()"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Makes the process of each step run this code instead."""

    def make(code: str) -> None:
        lines = [
            "import json, os, signal, subprocess, sys",
            "from pathlib import Path",
            "from benchmarks.first_hour import step",
            "from benchmarks.first_hour.outcome import Context, Outcome",
            "context = Context(**json.loads(sys.argv[1]))",
            "step.end_together()",
            code,
        ]
        (tmp_path / "faked_step.py").write_text("\n".join(lines))
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
        monkeypatch.setattr(supervise, "MODULE", "faked_step")

    return make


def ended(pid: int) -> bool:
    """Whether a process is gone, or a zombie that its new parent has not collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except FileNotFoundError:
        return True


def steps_of(folder: Path) -> dict[str, dict[str, str]]:
    """What the program has stored of each step."""
    found: dict[str, dict[str, str]] = json.loads((folder / "first-hour.json").read_bytes())["steps"]
    return found


@pytest.mark.parametrize(
    ("code", "ending", "reason"),
    [
        (PASSES, "passed", ""),
        ("raise ValueError('no kernel')", "failed", "ValueError: no kernel"),
        ("sys.exit(3)", "failed", "ended with exit code 3"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "failed", "ended by SIGSEGV"),
        ("pass", "failed", "it left no result"),
    ],
)
def test_a_step_leaves_its_outcome_or_says_why(
    tmp_path: Path, fake: Fake, code: str, ending: str, reason: str
) -> None:
    fake(code)
    outcome = supervise.run(Context("tests", str(tmp_path), "cpu", 600), lambda *_: None).outcome
    assert (outcome.ending, outcome.reason) == (ending, reason)


def test_a_step_that_hangs_is_stopped_with_what_it_started(
    tmp_path: Path, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it has measured so far is kept; the last line of its log is its progress."""
    monkeypatch.setattr(supervise, "TICK_S", 0.1)
    monkeypatch.setattr(supervise, "GRACE_S", 0.2)
    fake(IGNORES)
    pid, seen = tmp_path / "tests" / "pid", list[str]()

    def clock() -> float:
        """The limit is over when the step hangs."""
        return 601.0 if pid.exists() and "block 1 of 2" in seen else 0.0

    context = Context("tests", str(tmp_path), "cpu", 600)
    outcome = supervise.run(context, lambda _, line: seen.append(line), clock).outcome
    assert (outcome.ending, outcome.figure) == ("failed", "3 of 9 rows")
    assert outcome.reason == "stopped after its limit of 600 s"
    wait_until(lambda: ended(int(pid.read_text())), "what it has started is ended")


def test_steps_share_the_time_that_is_left() -> None:
    names = list(STEPS)
    left, limits = 1500.0, []
    for number in range(len(names)):
        limits.append(limit(names[number:], left))
        left -= limits[-1]
    assert left == pytest.approx(0.0, abs=1e-6)
    assert limits[names.index("tests")] == max(limits)
    assert limit(["gsplat"], 700.0) == 700.0  # the last one has all that the others left over


def test_the_page_has_every_step_and_the_exit_code_is_that_of_a_failure(tmp_path: Path, fake: Fake) -> None:
    fake("context.save(Outcome('failed' if context.step == 'demo' else 'skipped', reason='no|card'))")
    folder = tmp_path / "out"
    assert program.main(["-o", str(folder), "--device", "cpu", "--only", "gsplat,demo"]) == 1
    page = (folder / "first-hour.md").read_text()
    assert "| **failed** |" in page and "no\\|card" in page
    assert page.index("| demo ") < page.index("| gsplat ")
    fake(PASSES)
    assert program.main(["-o", str(folder), "--device", "cpu", "--only", "demo"]) == 0
    endings = {name: step["ending"] for name, step in steps_of(folder).items()}
    assert endings == {"demo": "passed", "gsplat": "skipped"}
    assert program.main(["-o", str(folder), "--device", "cpu", "--minutes", "0.01"]) == 0
    reasons = {step["reason"] for step in steps_of(folder).values()}
    assert reasons == {"no time was left of --minutes 0.01"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "demo,tets"], "'tets' is none of machine, tests"),
        (["--minutes", "0"], "--minutes 0: must be above 0"),
        (["--scene", "nowhere"], "--scene nowhere: there is no such folder"),
        (["--model", "model.ply"], "needs the --scene"),
        (["--device", "cpu"], "has other files"),
    ],
)
def test_bad_options_and_a_folder_of_something_else(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    try:
        code = program.main(["-o", str(tmp_path), *options])
    except SystemExit as ending:
        code = int(str(ending))
    assert code == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]
