"""A search for poses that is interrupted resumes with what it has found, and ends in the same poses."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from tests.prepare.sfm.consistency.simulated import Place, parts_of, square

pytestmark = pytest.mark.system

COUNT = 16  # panoramas


def _poses(place: Place) -> dict[int, bytes]:
    (found,) = parts_of(place)
    return {row: b"".join(part.tobytes() for part in pose) for row, pose in found.found.poses.items()}


@pytest.mark.parametrize("direct", [COUNT, COUNT - 1])
def test_an_interrupted_search_resumes_and_ends_in_the_same_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, direct: int
) -> None:
    """The interruption comes in the last adjustment: nothing before that is computed again.

    Of more than the mapper adjusts, nor is what follows it with the database that it has changed.
    """
    steps, stop = list[str](), -1
    for module in ("mapping", "consistency.solve"):
        monkeypatch.setattr(f"panolog.prepare.sfm.{module}.DIRECT", direct)

    def noted(name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        def noting(*arguments: Any) -> Any:
            if len(steps) == stop:
                raise KeyboardInterrupt
            steps.append(name)
            return step(*arguments)

        return noting

    for name in ("IncrementalPipeline", "create_default_bundle_adjuster"):
        monkeypatch.setattr(pycolmap, name, noted(name, getattr(pycolmap, name)))
    (tmp_path / "whole").mkdir()
    undisturbed, whole = _poses(square(tmp_path / "whole", count=COUNT)), tuple(steps)
    assert whole.count("IncrementalPipeline") > (direct == COUNT)
    place, stop = square(tmp_path, count=COUNT), len(whole) - 1
    steps.clear()
    with pytest.raises(KeyboardInterrupt):
        _poses(place)
    assert tuple(steps) == whole[:-1]
    steps.clear()
    stop = -1
    assert _poses(place) == undisturbed
    assert steps == ["create_default_bundle_adjuster"] * 2  # the last adjustment is of two
    assert _poses(place) == undisturbed
    assert len(steps) == 2


def test_other_matches_are_not_taken_for_those_of_before(tmp_path: Path) -> None:
    place = square(tmp_path, count=COUNT)
    work, rows = place.work, {(0, 1): np.array([[0, 0], [1, 1]]), (1, 2): np.array([[2, 2], [3, 3]])}
    calls = list[int]()

    def make() -> list[pycolmap.Reconstruction]:
        calls.append(len(calls))
        return []

    for kept in (rows, rows, {**rows, (1, 2): np.array([[2, 2], [4, 4]])}):
        part = work.with_pairs(kept, "pairs.db")
        assert part.once("key", [], make) == []
    assert calls == [0, 1]
    part.once("another key", [], make)
    assert calls == [0, 1, 2]
