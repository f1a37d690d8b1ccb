"""The overhead's benchmark: runs and plain processes do the same work."""

from pathlib import Path

import pytest

from benchmarks.overhead import QUICK, Turn, Turns, measure

pytestmark = pytest.mark.system


def test_runs_and_plain_processes_end_with_the_same_bytes(tmp_path: Path) -> None:
    measured = measure(tmp_path, QUICK)
    assert [turn.name for turn in measured.turns] == ["run", "plain", "run"]
    first, plain, _ = measured.turns
    # Each of two blocks saves twice, but not before the driver has taken its last file: so it may be once.
    assert first.checkpoints in (2, 3, 4) and plain.checkpoints == 0
    assert set(first.digests) == {"block/000", "block/001"}
    assert first.digests == plain.digests
    assert all(turn.seconds > turn.training > 0 for turn in measured.turns)


def test_the_cost_is_that_of_both_runs_and_the_noise_is_between_them() -> None:
    first, plain, second = (Turn(name, s, s, 0, {}) for name, s in (("run", 11), ("plain", 10), ("run", 10)))
    turns = Turns((first, plain, second))
    assert turns.cost == pytest.approx(0.05)
    assert turns.noise == pytest.approx(0.1)
