"""Steps that fail, hang or are killed: each leaves its reason, and what was done before stays."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.first_hour import __main__ as program
from benchmarks.first_hour import supervise
from benchmarks.first_hour.outcome import ROOT, Context
from benchmarks.first_hour.steps import STEPS, limit

Fake = Callable[[str], None]  # makes the process of each step run this code

PASSES = "context.save(Outcome('passed', '7 ms'))"
HANGS = """
context.save(Outcome('passed', '3 of 9 rows'))
child = subprocess.Popen(['sleep', '600'])
Path(context.work, 'pid').write_text(str(child.pid))
signal.pause()
"""


def run(folder: Path, seconds: float = 60.0) -> supervise.Ran:
    return supervise.run(Context("tests", str(folder), "cpu", seconds), lambda *_: None)


def test_what_a_step_saves_is_its_outcome(tmp_path: Path, fake: Fake) -> None:
    fake(PASSES)
    ran = run(tmp_path)
    assert (ran.outcome.ending, ran.outcome.figure, ran.outcome.reason) == ("passed", "7 ms", "")


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ValueError('no kernel')", "ValueError: no kernel"),
        ("sys.exit(3)", "ended with exit code 3"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV"),
        ("pass", "it left no result"),
    ],
)
def test_a_step_that_fails_says_why(tmp_path: Path, fake: Fake, code: str, reason: str) -> None:
    fake(code)
    ran = run(tmp_path)
    assert (ran.outcome.ending, ran.outcome.reason) == ("failed", reason)


def test_a_step_that_hangs_is_stopped_with_what_it_started(tmp_path: Path, fake: Fake) -> None:
    """What it has measured so far is kept."""
    fake(HANGS)
    ran = run(tmp_path, seconds=6.0)
    assert ran.outcome.ending == "failed"
    assert ran.outcome.reason == "stopped after its limit of 6 s"
    assert ran.outcome.figure == "3 of 9 rows"
    assert ran.seconds < 30
    wait_for(lambda: ended(int((tmp_path / "tests" / "pid").read_text())))


def ended(pid: int) -> bool:
    """Whether a process is gone, or a zombie that its new parent has not collected."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except FileNotFoundError:
        return True


def wait_for(condition: Callable[[], bool]) -> None:
    """Looks every 50 ms, for a minute at most."""
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_step_that_ignores_the_end_is_killed(
    tmp_path: Path, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise, "_GRACE_S", 0.2)
    fake("signal.signal(signal.SIGTERM, signal.SIG_IGN)\nwhile True: signal.pause()")
    assert run(tmp_path, seconds=5.0).outcome.reason == "stopped after its limit of 5 s"


def test_progress_is_the_last_line_of_the_log(
    tmp_path: Path, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervise, "_TICK_S", 0.2)
    fake("print('block 1 of 2', flush=True)\nsignal.pause()")
    seen: list[str] = []
    supervise.run(Context("tests", str(tmp_path), "cpu", 6.0), lambda _, line: seen.append(line))
    assert "block 1 of 2" in seen


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


def test_a_killed_program_keeps_what_was_done(tmp_path: Path, fake: Fake) -> None:
    """Its step ends with it; the next start has the results of before."""
    fake(PASSES)
    folder = tmp_path / "out"
    assert program.main(["-o", str(folder), "--device", "cpu", "--only", "machine"]) == 0
    fake(HANGS)
    code = (
        "import sys; from benchmarks.first_hour import __main__, supervise;"
        f"supervise.MODULE = 'faked_step'; sys.exit(__main__.main({['-o', str(folder), '--device', 'cpu']}))"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([os.environ["PYTHONPATH"], str(ROOT)])}
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE) as process:
        pid = folder / "machine" / "pid"
        wait_for(pid.exists)
        process.kill()
    wait_for(lambda: ended(int(pid.read_text())))
    steps = json.loads((folder / "first-hour.json").read_bytes())["steps"]
    assert steps["machine"]["reason"].startswith("not finished")
    assert "not finished" in (folder / "first-hour.md").read_text()


def test_steps_without_time_are_skipped(tmp_path: Path, fake: Fake) -> None:
    fake(PASSES)
    folder = tmp_path / "out"
    assert program.main(["-o", str(folder), "--device", "cpu", "--minutes", "0.01"]) == 0
    steps = json.loads((folder / "first-hour.json").read_bytes())["steps"]
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
