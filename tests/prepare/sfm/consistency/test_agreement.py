"""Whether pairs agree with poses, of which a part of the matches belongs to copies of a house."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import agrees
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, directions
from panolog.prepare.sfm.consistency.motion import Motion, mark
from panolog.prepare.sfm.consistency.skeleton import widest_tree

Array = NDArray[np.float64]


def _around(count: int, ahead: int) -> Array:
    """(N, 3) directions: `count` all around, then `ahead` near one."""
    random = np.random.default_rng(0)
    near = np.array([0, 0, 1.0]) + random.normal(0, 0.05, (ahead, 3))
    rays = np.concatenate([random.normal(size=(count, 3)), near])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@pytest.mark.parametrize(
    ("fitting", "verdict"),
    [(slice(200), True), (slice(200, 400), False), (slice(260), True), (slice(0), False)],
    ids=["around", "ahead", "most", "none"],
)
def test_those_all_around_outweigh_more_on_one_side(fitting: slice, verdict: bool) -> None:
    rays = _around(200, 300)
    pair = Pair((0, 1), np.repeat(np.arange(500)[:, None], 2, axis=1))
    off = np.full(500, 30.0)
    off[fitting] = 0.1
    evidence = Evidence((rays, rays), (pair,))
    assert agrees(evidence, pair, off, 2.0) is verdict
    off[9:] = np.nan
    assert agrees(evidence, pair, off, 2.0) is None  # too few are known


@pytest.mark.parametrize(("known", "verdict"), [(12, True), (13, None), (15, None), (16, False)])
def test_a_few_that_do_not_fit_contradict_nothing(known: int, verdict: bool | None) -> None:
    rays = _around(0, 40)
    pair = Pair((0, 1), np.repeat(np.arange(40)[:, None], 2, axis=1))
    off = np.where(np.arange(40) < known, 30.0, np.nan)
    off[:6] = 0.1
    assert agrees(Evidence((rays, rays), (pair,)), pair, off, 2.0) is verdict


def test_what_is_far_away_says_nothing_of_where_a_pair_stands() -> None:
    random = np.random.default_rng(1)
    near, far = (random.normal(size=(150, 3)) * size for size in (5.0, 5e4))
    points = np.concatenate([near, far])
    rotation, shift = Rotation.from_euler("y", 25, degrees=True).as_matrix(), np.array([0.3, 0.0, -1.0])
    rays = [it / np.linalg.norm(it, axis=1, keepdims=True) for it in (points, points @ rotation.T + shift)]
    pair = Pair((0, 1), np.repeat(np.arange(300)[:, None], 2, axis=1))
    evidence = Evidence(tuple(rays), (pair,))
    marked = mark(evidence, pair, Motion(rotation, shift / np.linalg.norm(shift)), np.deg2rad(0.5))
    assert marked.moved is not None and not marked.moved[150:].any()
    assert marked.moved[:150].mean() > 0.9 and 2 < marked.parallax < 30
    nothing = mark(evidence, pair, None, np.deg2rad(0.5))
    assert len(nothing.telling) == 0 and nothing.parallax == 0


def test_the_widest_way_avoids_a_pair_that_covers_little() -> None:
    coverage = {(0, 1): 0.9, (1, 2): 0.3, (0, 3): 0.8, (2, 3): 0.7, (4, 5): 0.0}
    nothing = np.empty((0, 2), np.int64)
    tree = widest_tree([Pair(edge, nothing, share) for edge, share in coverage.items()], 6)
    assert tree == {edge: coverage[edge] for edge in [(0, 1), (0, 3), (2, 3), (4, 5)]}
    assert widest_tree([], 3) == {}
    assert directions(_around(0, 90)) < 5 < directions(_around(200, 0))
