"""Steps that fail, hang or are killed: each leaves its reason, and what was done before stays."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.first_hour import __main__ as program
from benchmarks.first_hour import supervise
from benchmarks.first_hour.outcome import ROOT, Context
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
PAUSES = f"{HANGS}signal.pause()"
IGNORES = f"signal.signal(signal.SIGTERM, signal.SIG_IGN){HANGS}while True: signal.pause()"


def ended(pid: int) -> bool:
    """Whether a process is gone, or a zombie that its new parent has not collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except FileNotFoundError:
        return True


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


@pytest.mark.parametrize("code", [PAUSES, IGNORES])
def test_a_step_that_hangs_is_stopped_with_what_it_started(
    code: str, tmp_path: Path, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it has measured so far is kept; the last line of its log is its progress."""
    monkeypatch.setattr(supervise, "TICK_S", 0.1)
    monkeypatch.setattr(supervise, "GRACE_S", 0.2 if code is IGNORES else 60.0)
    fake(code)
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
    assert "| demo " in page and "| **failed** |" in page and "no\\|card" in page
    assert page.index("| demo ") < page.index("| gsplat ")
    fake(PASSES)
    assert program.main(["-o", str(folder), "--device", "cpu", "--only", "demo"]) == 0
    steps = json.loads((folder / "first-hour.json").read_bytes())["steps"]
    assert {name: step["ending"] for name, step in steps.items()} == {"demo": "passed", "gsplat": "skipped"}


def test_a_killed_program_ends_its_step_and_keeps_what_was_done(tmp_path: Path, fake: Fake) -> None:
    fake(PAUSES)
    folder = tmp_path / "out"
    code = (
        "import sys; from benchmarks.first_hour import __main__, supervise;"
        f"supervise.MODULE = 'faked_step'; sys.exit(__main__.main({['-o', str(folder), '--device', 'cpu']}))"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([os.environ["PYTHONPATH"], str(ROOT)])}
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE) as process:
        pid = folder / "machine" / "pid"
        wait_until(pid.exists, "the first step hangs")
        process.kill()
    wait_until(lambda: ended(int(pid.read_text())), "the step and what it has started are ended")
    steps = json.loads((folder / "first-hour.json").read_bytes())["steps"]
    assert steps["machine"]["reason"].startswith("not finished")
    assert "not finished" in (folder / "first-hour.md").read_text()


def test_steps_without_time_are_skipped(tmp_path: Path, fake: Fake) -> None:
    fake(PASSES)
    assert program.main(["-o", str(tmp_path / "out"), "--device", "cpu", "--minutes", "0.01"]) == 0
    steps = json.loads((tmp_path / "out" / "first-hour.json").read_bytes())["steps"]
    assert {step["reason"] for step in steps.values()} == {"no time was left of --minutes 0.01"}
    assert list(steps) == list(STEPS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--only", "demo,tets"], "'tets' is none of machine, tests"),
        (["--minutes", "0"], "--minutes 0: must be above 0"),
        (["--only", "demo", "--skip", "demo"], "leave no step"),
        (["--scene", "nowhere"], "--scene nowhere: there is no such folder"),
        (["--model", "model.ply"], "needs the --scene"),
    ],
)
def test_bad_options(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ending:
        program.main(options)
    assert ending.value.code == 2
    assert message in capsys.readouterr().err


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene").mkdir()
    assert program.main(["-o", str(tmp_path), "--device", "cpu"]) == 2
    assert "has other files" in capsys.readouterr().err
    assert (tmp_path / "scene").exists()
