"""pytest and compute-sanitizer as steps: what they did is known whatever ends them."""

import pytest

from benchmarks.first_hour import sanitizer, suites
from benchmarks.first_hour.outcome import Context, Outcome

LOG = """
some_tests.py::test_before PASSED [ 33%]
some_tests.py::test_without_a_card SKIPPED (no card) [ 66%]
some_tests.py::test_hangs """
CARD, REHEARSAL = (Context("tests", "", device, 60) for device in ("cuda", "cpu"))


def test_a_test_that_hangs_is_named() -> None:
    outcome = suites.judged(CARD, suites.read_log(LOG), (), whole=False)
    assert outcome.figure == "1 passed, 1 failed, 1 skipped"
    assert outcome.reason == "1 fail; not all of them ran"
    assert list(outcome.content["failed"]) == ["some_tests.py::test_hangs"]


def test_skipped_tests_are_a_failure_on_a_card() -> None:
    skipped = suites.Suite(skipped=["a"])
    found = [suites.judged(context, skipped, (), whole=True) for context in (REHEARSAL, CARD)]
    assert [(it.ending, it.reason) for it in found] == [("skipped", "no card"), ("failed", "no test passed")]


def test_what_fails_after_an_error_of_the_card_runs_again_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(_context: Context, command: list[str], *_: object) -> tuple[suites.Suite, bool]:
        second = command[-1] == "b"
        return suites.Suite(passed=["b"] * second, failed={} if second else {"a": "x"}), True

    first = suites.Suite(failed={"a": "RuntimeError: CUDA error: illegal", "b": "RuntimeError: CUDA error"})
    monkeypatch.setattr(suites, "run", run)
    first.alone = dict(suites.alone(CARD, first.failed, float("inf")))
    assert first.alone == {"a": False, "b": True}
    outcome = suites.judged(CARD, first, (), whole=True)
    assert outcome.reason == "1 fail; 1 fail only after an error of another test"
    assert "`b` (passes alone)" in outcome.text


OUT_OF_BOUNDS = """========= COMPUTE-SANITIZER
========= Invalid __global__ write of size 4 bytes
=========     at composite_forward+0x1b0 in composite.cu:34
=========     by thread (7,0,0) in block (1,0,0)
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
========= ERROR SUMMARY: 1 error
"""


@pytest.mark.parametrize(
    ("log", "ending", "reports", "reason"),
    [
        ("========= ERROR SUMMARY: 0 errors\n", "passed", "0 reports, 0 of them in our kernels; ", ""),
        (
            OUT_OF_BOUNDS,
            "failed",
            "2 reports, 2 of them in our kernels; ",
            "reports in composite_forward, project_backward",
        ),
        (RACE, "failed", "1 reports, 1 of them in our kernels; ", "reports in loss_similarity"),
        (OF_TORCH, "passed", "1 reports, 0 of them in our kernels; ", ""),
        ("========= Error: No device.\n", "failed", "", "compute-sanitizer: Error: No device."),
        ("", "failed", "", "compute-sanitizer: it wrote no summary"),
    ],
)
def test_what_a_sanitizer_reports(log: str, ending: str, reports: str, reason: str) -> None:
    found = sanitizer.judged(Outcome("passed", "61 passed"), log)
    assert (found.ending, found.figure, found.reason) == (ending, f"{reports}61 passed", reason)
