"""pytest and compute-sanitizer as steps: what they did is known whatever ends them."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.first_hour import sanitizer, suites, supervise
from benchmarks.first_hour.outcome import ROOT, Context, Outcome

Fake = Callable[[str], None]

CRASHES = """
import os, pytest
def test(): pass
def test_crash(): os.abort()
def test_crash_not(): pass
@pytest.mark.parametrize("name", ["with a space"])
def test_after(name): pass
"""
HANGS = """
import signal
def test_before(): pass
def test_hangs(): signal.pause()
"""
STICKY = """
broken = False
def test_first():
    global broken
    broken = True
    raise RuntimeError("CUDA error: an illegal memory access was encountered")
def test_second():
    assert not broken, "CUDA error"
"""


def outcome_of(
    content: str, tmp_path: Path, fake: Fake, device: str = "cuda", seconds: float = 60
) -> Outcome:
    """That of the step `tests` over a file with this content."""
    (tmp_path / "some_tests.py").write_text(content)
    options = ["-vv", "-o", "junit_family=xunit1", "-p", "no:cacheprovider", "some_tests.py"]
    fake(
        "from benchmarks.first_hour import outcome, suites\n"
        f"outcome.ROOT = {str(tmp_path)!r}\n"
        f"os.environ['PYTHONPATH'] += {f':{ROOT}'!r}\n"
        f"suites.PYTEST = {[sys.executable, '-m', 'pytest', *options]}\n"
        "context.save(suites.tests(context))"
    )
    return supervise.run(Context("tests", str(tmp_path), device, seconds), lambda *_: None).outcome


def test_a_test_that_ends_the_process_is_named_and_the_others_run(tmp_path: Path, fake: Fake) -> None:
    outcome = outcome_of(CRASHES, tmp_path, fake)
    assert (outcome.ending, outcome.figure, outcome.reason) == ("failed", "3 passed, 1 failed", "1 fail")
    assert outcome.content["failed"] == {
        "some_tests.py::test_crash": "the process ended or was stopped in it"
    }
    assert "some_tests.py::test_after[with a space]" in outcome.content["passed"]


def test_a_test_that_hangs_is_named(tmp_path: Path, fake: Fake) -> None:
    outcome = outcome_of(HANGS, tmp_path, fake, seconds=15)
    assert (outcome.figure, outcome.reason) == ("1 passed, 1 failed", "1 fail; not all of them ran")
    assert list(outcome.content["failed"]) == ["some_tests.py::test_hangs"]


def test_what_fails_after_an_error_of_the_card_runs_again_alone(
    tmp_path: Path, fake: Fake, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[list[str]] = []

    def run(_context: Context, command: list[str], *_: object) -> tuple[suites.Suite, bool]:
        calls.append(command)
        second = command[-1] == "b"
        return suites.Suite(passed=["b"] * second, failed={} if second else {"a": "x"}), True

    first = suites.Suite(failed={"a": "RuntimeError: CUDA error: illegal", "b": "RuntimeError: CUDA error"})
    monkeypatch.setattr(suites, "run", run)
    alone = dict(suites._alone(Context("tests", str(tmp_path), "cuda", 60), first.failed, float("inf")))
    assert alone == {"a": False, "b": True}
    first.alone = alone
    outcome = suites.judged(Context("tests", "", "cuda", 60), first, (), whole=True)
    assert outcome.reason == "1 fail; 1 fail only after an error of another test"
    assert "`b` (passes alone)" in outcome.text


@pytest.mark.parametrize(
    ("device", "ending", "reason"), [("cpu", "skipped", "no card"), ("cuda", "failed", "no test passed")]
)
def test_skipped_tests(tmp_path: Path, fake: Fake, device: str, ending: str, reason: str) -> None:
    skipping = "import pytest\ndef test_on_a_card(): pytest.skip('there is no CUDA card')"
    outcome = outcome_of(skipping, tmp_path, fake, device)
    assert (outcome.ending, outcome.figure, outcome.reason) == (ending, "1 skipped", reason)


def test_a_package_that_is_missing_is_a_note(tmp_path: Path, fake: Fake) -> None:
    outcome = outcome_of("import a_package_that_is_missing", tmp_path, fake)
    assert outcome.reason.endswith("1 files were not collected, without a_package_that_is_missing")


CLEAN = "========= COMPUTE-SANITIZER\n========= ERROR SUMMARY: 0 errors\n"
OUT_OF_BOUNDS = """========= COMPUTE-SANITIZER
========= Invalid __global__ write of size 4 bytes
=========     at composite_forward+0x1b0 in composite.cu:34
=========     by thread (7,0,0) in block (1,0,0)
=========     Address 0x7f is out of bounds
========= Invalid __global__ read of size 16 bytes
=========     at project_backward+0x70 in project.cu:80
========= ERROR SUMMARY: 2 errors
"""
RACE = """========= COMPUTE-SANITIZER
========= Error: Race reported between Write access at loss_similarity+0x70 in loss.cu:11
=========     and Read access at loss_similarity+0xd0 in loss.cu:12 [508 hazards]
=========
========= RACECHECK SUMMARY: 1 hazard displayed (1 error, 0 warnings)
"""
OF_TORCH = """========= COMPUTE-SANITIZER
========= Uninitialized __global__ memory read of size 4 bytes
=========     at void cub::DeviceRadixSortOnesweepKernel<int>(int *, int)+0x70
=========     by thread (0,0,0) in block (0,0,0)
========= ERROR SUMMARY: 1 error
"""


@pytest.mark.parametrize(
    ("log", "ending", "figure", "reason"),
    [
        (CLEAN, "passed", "0 reports, 0 of them in our kernels; 61 passed", ""),
        (
            OUT_OF_BOUNDS,
            "failed",
            "2 reports, 2 of them in our kernels; 61 passed",
            "reports in composite_forward, project_backward",
        ),
        (RACE, "failed", "1 reports, 1 of them in our kernels; 61 passed", "reports in loss_similarity"),
        (OF_TORCH, "passed", "1 reports, 0 of them in our kernels; 61 passed", ""),
        (
            "========= Error: Device not supported.\n",
            "failed",
            "61 passed",
            "compute-sanitizer: Error: Device not supported.",
        ),
        ("", "failed", "61 passed", "compute-sanitizer: it wrote no summary"),
    ],
)
def test_what_a_sanitizer_reports(log: str, ending: str, figure: str, reason: str) -> None:
    found = sanitizer.judged(Outcome("passed", "61 passed"), log)
    assert (found.ending, found.figure, found.reason) == (ending, figure, reason)


def test_the_sanitizer_of_a_wheel_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PATH", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.setenv(name, "")
    """Not that of a wheel without the programs that start the target."""
    program = tmp_path / "nvidia" / "cu99" / "compute-sanitizer" / "compute-sanitizer"
    for file in (program, tmp_path / "nvidia" / "cu98" / "bin" / "compute-sanitizer"):
        file.parent.mkdir(parents=True)
        file.touch(mode=0o755)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert sanitizer.find_program() == program


def test_without_a_sanitizer_the_step_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sanitizer, "find_program", lambda: None)
    outcome = sanitizer.check(Context("memcheck", str(tmp_path), "cuda", 60))
    assert outcome.ending == "skipped" and "nvidia-cuda-sanitizer-api>=13.5" in outcome.reason
