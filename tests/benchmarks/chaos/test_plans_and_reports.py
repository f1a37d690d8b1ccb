"""What goes wrong when, and what the benchmarks compute and report of runs that are not as they should be."""

from collections import Counter

from benchmarks.chaos.__main__ import Outcome
from benchmarks.chaos.faults import LIMITS, Kind, Planned, plans
from benchmarks.chaos.runs import Fault, Run


def test_equal_seeds_give_equal_plans_with_every_kind_equally_often() -> None:
    first, again, other = (list(plans(40, seed, 40.0, tuple(Kind))) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2}
    assert all([it.after for it in plan] == sorted(it.after for it in plan) for plan in first)
    counts = Counter(planned.kind for plan in first for planned in plan)
    assert counts.keys() == LIMITS.keys() == set(Kind)
    assert max(counts.values()) - min(counts.values()) <= 1


def test_other_bytes_and_runs_that_take_too_long_are_reported() -> None:
    faults = (Fault(5.0, Planned(4.0, Kind.ENOSPC, 0.0)), Fault(9.0, Planned(8.0, Kind.WORKER, 0.0)))
    allowed = 2 * 30.0 + 3.0 + LIMITS[Kind.ENOSPC].costs + LIMITS[Kind.WORKER].costs
    undisturbed = Run(0, 30.0, (), "a", "")
    runs = [
        Run(1, allowed - 1, faults, "a", ""),
        Run(2, allowed + 1, faults, "b", ""),
        Run(3, 9.0, (), "", "exit code 1: no"),
    ]
    outcome = Outcome((undisturbed, *runs))
    assert outcome.failures() == [
        "run 2: other bytes",
        f"run 2: took {allowed + 1:.1f} s of {allowed:.1f} s",
        "run 3: exit code 1: no",
    ]
    assert [row[-1] for row in outcome.rows()] == ["same", "OTHER", "failed"]
    assert next(outcome.rows())[1] == "enospc 3 s at 5.0 s, worker at 9.0 s"
