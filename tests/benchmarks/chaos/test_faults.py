"""Which faults come when: plans and the option --faults."""

import argparse

import pytest

from benchmarks.chaos.__main__ import kinds_of
from benchmarks.chaos.faults import LIMITS, Kind, plans


def test_equal_seeds_give_equal_plans() -> None:
    first, again, other = (list(plans(40, seed, 40.0, tuple(Kind))) for seed in (0, 0, 1))
    assert first == again != other
    assert {len(plan) for plan in first} == {1, 2}
    for plan in first:
        assert [planned.after for planned in plan] == sorted(planned.after for planned in plan)


def test_every_kind_comes_equally_often() -> None:
    kinds = [planned.kind for plan in plans(40, 0, 40.0, tuple(Kind)) for planned in plan]
    counts = {kind: kinds.count(kind) for kind in Kind}
    assert max(counts.values()) - min(counts.values()) <= 1
    assert LIMITS.keys() == set(Kind)


def test_faults_are_chosen_by_name() -> None:
    assert kinds_of("all") == tuple(Kind)
    assert kinds_of("kill,hang") == (Kind.DRIVER, Kind.WORKER, Kind.RAYLET, Kind.HANG)
    with pytest.raises(argparse.ArgumentTypeError, match=r"flood.*enospc"):
        kinds_of("hang,flood")
