"""The benchmark of the merge: it merges what it fills in, and would notice if that were wrong."""

from pathlib import Path

import pytest

from benchmarks.merge_scale import ROW, SKY, _check, fill, measure
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import join_ply, ply_header


@pytest.mark.system
def test_the_merge_is_measured_between_two_copies(tmp_path: Path) -> None:
    turns = measure(tmp_path, blocks=3, gaussians=500, seed=1)
    assert [turn.name for turn in turns] == ["cat", "merge", "cat"]
    merge = turns[1]
    assert merge.before is not None and merge.peak is not None
    assert 0 < merge.before <= merge.peak
    assert merge.speed * merge.seconds * 1e6 == pytest.approx((500 + SKY) * ROW, rel=1e-3)


def test_a_wrong_merge_is_noticed(tmp_path: Path) -> None:
    first, *rest = fill(RunFolder(tmp_path), 3, 500, seed=1)
    wrong = [(path, range(ply_header(path)[0])) for path in [*rest[:-1], first, rest[-1]]]
    join_ply(tmp_path / "wrong.ply", wrong, sky=SKY)
    with pytest.raises(RunError, match="differs"):
        _check([first, *rest], tmp_path / "wrong.ply")


def test_a_full_disk_is_noticed_first(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="free disk"):
        measure(tmp_path, blocks=1, gaussians=10**13, seed=0)
