"""Panoramas that stand far from those before and after them in the order: left out unless confirmed."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from panolog.prepare.sfm.consistency.agreement import Posed
from panolog.prepare.sfm.consistency.evidence import Pair
from panolog.prepare.sfm.consistency.skeleton import Edge
from panolog.prepare.sfm.consistency.solution import Solution
from panolog.prepare.sfm.consistency.solve import _strays, _unconfirmed


def _walk(first: int, count: int) -> Posed:
    """Sixteen panoramas, so many of which stand 400 steps away."""
    steps = np.arange(16.0)
    steps[first : first + count] += 400.0
    return Posed({row: (np.eye(3), np.array([-step, 0.0, 0.0])) for row, step in enumerate(steps)}, {})


def test_a_panorama_far_from_those_around_it_in_the_order_is_a_stray() -> None:
    centers = np.array([[step, 0.0, 0.0] for step in [*range(8), 20, 21, 22, 23]])
    apart = np.where(np.arange(12)[:, None] == 4, [40.0, 0.0, 0.0], centers)
    for where, strays in ((centers, set()), (apart, {4}), (apart[:2], set()), (apart[:5], set())):
        poses = {row: (np.eye(3), -center) for row, center in enumerate(where)}
        assert _strays(Posed(poses, {}), set()) == strays


@pytest.mark.parametrize(
    "count, firm, strays",
    [
        (3, {(4, 5), (5, 6), (7, 8)}, {4, 5, 6}),
        (4, set(), {4, 5, 6, 7}),
        (5, set(), set()),  # so many may be a way of their own
        (3, {(3, 4), (4, 5)}, set()),
        (3, {(4, 5), (6, 7)}, set()),
        (3, {(4, 5), (6, 16)}, {4, 5, 6}),  # the last one has no pose
    ],
)
def test_a_few_panoramas_that_stray_together_are_strays(
    count: int, firm: set[Edge], strays: set[int]
) -> None:
    assert _strays(_walk(4, count), firm) == strays


@pytest.mark.parametrize(
    "leading, against, unconfirmed",
    [
        ([(5, 12)], (), {4, 5, 6}),
        ([(4, 6), (5, 12)], (), {4, 5, 6}),
        ([(4, 11), (5, 12)], (), set()),
        ([(4, 11), (5, 12)], (3, 4), {4, 5, 6}),  # all of a copy of a place agree
        ([(4, 11), (5, 12)], (2, 4), set()),
    ],
)
def test_neighbours_that_stray_do_not_confirm_each_other(
    leading: list[Edge], against: Edge, unconfirmed: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "panolog.prepare.sfm.consistency.solve"
    monkeypatch.setattr(f"{module}.deviations", lambda *_: np.zeros(0))
    monkeypatch.setattr(f"{module}.agrees", lambda _, pair, *__: pair.between != against)
    firm = {(row, row + 1) for row in range(15)} - {(3, 4), (6, 7)}
    pairs = [Pair(edge, np.empty((0, 2), np.int64)) for edge in sorted({*firm, *leading, against} - {()})]
    skeleton = SimpleNamespace(ordered=True, given=set(), certain=firm, tree={*firm, leading[0]})
    evidence = SimpleNamespace(pairs=pairs, rays=[None] * 16)
    solution = SimpleNamespace(skeleton=skeleton, found=_walk(4, 3), evidence=evidence)
    assert _unconfirmed(cast(Solution, solution)) == unconfirmed
