"""What goes wrong when, and what the benchmarks compute and report of runs that are not as they should be."""

from collections import Counter

from benchmarks.chaos.__main__ import Outcome
from benchmarks.chaos.fault_costs import Fault, FaultCost
from benchmarks.chaos.faults import LIMITS, Kind, plans
from benchmarks.chaos.runs import Run
from panolog.workers.tasks import COARSE


def test_equal_seeds_give_equal_plans_with_every_kind_equally_often() -> None:
    first, again, other = (list(plans(40, seed, 40.0, tuple(Kind))) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2}
    assert all([it.after for it in plan] == sorted(it.after for it in plan) for plan in first)
    counts = Counter(planned.kind for plan in first for planned in plan)
    assert counts.keys() == LIMITS.keys() == set(Kind)
    assert max(counts.values()) - min(counts.values()) <= 1


def test_other_bytes_and_too_long_losses_are_reported() -> None:
    allowed = 2.0 + LIMITS[Kind.WORKER].costs
    long = FaultCost((Fault(5.0, Kind.WORKER, "kill"),), (COARSE,), 3.0, ((5.0, 5.0 + allowed),))
    short = FaultCost((Fault(9.0, Kind.WORKER, "kill"),), (COARSE,), 1.0, ((9.0, 9.0 + allowed - 1),))
    runs = [Run(0, 0.0, 30.0, (), "a", ""), Run(1, 0.0, 45.0, (long, short), "b", "")]
    outcome = Outcome(tuple(runs), interval=2.0)
    assert outcome.failures() == [
        "run 1: other bytes",
        f"run 1: lost {allowed + 3:.1f} s of {allowed:.1f} s",
    ]
    assert [row[0] for row in outcome.rows()] == [1, 1]
    failed = Outcome((runs[0], Run(1, 0.0, 9.0, (), "", "exit code 1: no")), 2.0)
    assert failed.failures() == ["run 1: exit code 1: no"]
