"""A walk around a block that returns to where it began, off by its drift, past a copy of a house."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import Posed, deviations
from panolog.prepare.sfm.consistency.closing import closed
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.motion import Motion
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton

Array = NDArray[np.float64]
COUNT, RADIUS, SEEN = 60, 40.0, 11.0  # panoramas, and metres: steps are 4.2
WALK = [(row, row + 1) for row in range(COUNT - 1)]
RETURN: list[Edge] = [(0, 58), (1, 59), (0, 59)]
COPIES: list[Edge] = [(10, 40), (11, 41), (10, 41)]  # of what is seen from 10 and 11, seen from 40 and 41


@dataclass(frozen=True, eq=False)
class Walk:
    """What is known of a walk."""

    found: Posed
    evidence: Evidence
    motions: dict[Edge, Motion]

    def closed(self, fixed: tuple[Edge, ...] = (), drift: float | None = None) -> Posed:
        """The poses once loops are closed."""
        return self.close(fixed, drift)[0]

    def close(self, fixed: tuple[Edge, ...] = (), drift: float | None = None) -> tuple[Posed, float]:
        """The poses once loops are closed, and the drift."""
        given = frozenset(row for edge in fixed for row in edge)
        skeleton = Skeleton(False, frozenset(WALK), given=given)
        return closed(self.found, self.evidence, skeleton, lambda pair: self.motions[pair.between], drift)

    def off(self, poses: Posed, edge: Edge) -> float:
        """Degrees between where the matches of a pair are seen and where they should be, their median."""
        (pair,) = (it for it in self.evidence.pairs if it.between == edge)
        return float(np.nanmedian(deviations(poses, self.evidence, pair)))


def _walk(turned: float, grown: float, loops: list[Edge]) -> Walk:
    """A walk that drifts at each step by degrees, and by a factor of its scale."""
    random = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, COUNT, endpoint=False) * 1.005
    centers = np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), np.zeros(COUNT)])
    axes = Rotation.from_euler("z", random.uniform(0, 360, (COUNT, 1)), degrees=True).as_matrix()
    around = random.uniform(0, 2 * np.pi, 2500)
    world = np.column_stack([RADIUS * np.cos(around), RADIUS * np.sin(around), np.zeros(2500)])
    world += random.uniform([-8, -8, -3], [8, 8, 5], (2500, 3))
    near = world[np.linalg.norm(world - centers[10], axis=1) < SEEN]
    half = Rotation.from_euler("z", np.rad2deg(angle[40] - angle[10]), degrees=True).as_matrix()
    copied, first = np.arange(len(near)), len(world)
    originals = np.flatnonzero(np.linalg.norm(world - centers[10], axis=1) < SEEN)
    world = np.concatenate([world, near @ half.T])
    seen = [np.flatnonzero(np.linalg.norm(world - center, axis=1) < SEEN) for center in centers]
    where = dict(zip(originals.tolist(), (first + copied).tolist(), strict=True))
    poses, points, rays, pairs, motions = {}, {}, [], [], {}
    moved, last, versions = np.eye(3), np.full(len(world), -2), np.zeros_like(world)
    shift, size = np.zeros(3), 1.0
    for row in range(COUNT):
        rays.append((world[seen[row]] - centers[row]) @ axes[row].T)
        new = seen[row][last[seen[row]] < row - 1]
        versions[new] = size * world[new] @ moved.T + shift
        last[seen[row]] = row
        points[row] = versions[seen[row]].copy()
        turn = axes[row] @ moved.T
        poses[row] = (turn, -turn @ (size * moved @ centers[row] + shift))
        turning = Rotation.from_euler("z", turned, degrees=True).as_matrix()
        center = size * moved @ centers[row] + shift
        moved, size = turning @ moved, size * grown
        shift = center - size * moved @ centers[row]
    for one, other in [*WALK, *loops]:
        alike = (one, other) in COPIES
        theirs = np.array([where.get(it, -1) if alike else it for it in seen[one].tolist()])
        place = {number: at for at, number in enumerate(seen[other].tolist())}
        matches = [(at, place[it]) for at, it in enumerate(theirs.tolist()) if it in place]
        copy = half if alike else np.eye(3)
        turn = axes[other] @ copy @ axes[one].T
        move = axes[other] @ (copy @ centers[one] - centers[other])
        motions[one, other] = Motion(turn, move / np.linalg.norm(move))
        pairs.append(Pair((one, other), np.array(matches, np.int64)))
    unit = tuple(it / np.linalg.norm(it, axis=1, keepdims=True) for it in rays)
    return Walk(Posed(poses, points), Evidence(unit, tuple(pairs)), motions)


@pytest.mark.parametrize(("turned", "grown"), [(0.1, 1.0), (0.0, 1.004), (-0.08, 0.997)])
def test_a_loop_that_drift_has_left_open_is_closed(turned: float, grown: float) -> None:
    walk = _walk(turned, grown, RETURN)
    straight = walk.closed()
    for edge in RETURN:
        assert walk.off(walk.found, edge) > 10
        assert walk.off(straight, edge) < 2
    for edge in WALK:
        assert walk.off(straight, edge) < 1


def test_look_alikes_that_confirm_each_other_close_no_loop() -> None:
    walk = _walk(0.1, 1.0, [*RETURN, *COPIES])
    straight = walk.closed()
    for edge in COPIES:
        assert walk.off(straight, edge) > 30
    for edge in RETURN:
        assert walk.off(straight, edge) < 2


@pytest.mark.parametrize(("turned", "loops", "stays"), [(0.1, 1, False), (0.17, 1, True), (0.17, 3, True)])
def test_a_loop_stays_open_that_the_way_does_not_explain(turned: float, loops: int, stays: bool) -> None:
    """Others that say the same do not explain it: so do look-alikes."""
    walk = _walk(turned, 1.0, RETURN[:loops])
    assert (walk.off(walk.closed(), RETURN[0]) > 10) == stays


@pytest.mark.parametrize("ordered", [False, True])
@pytest.mark.parametrize("turned", [0.1, 0.17])
def test_the_order_of_capture_confirms_neighbours(
    turned: float, ordered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their loops may be open farther than others, as the order distinguishes them from look-alikes."""
    monkeypatch.setattr("panolog.prepare.sfm.consistency.closing._LEVELS", ((1.0, 10),))
    walk = _walk(turned, 1.0, RETURN[:1])
    rows = [0, *range(2, 59), 1, 59]  # the ends of the loop are neighbours
    before, evidence = walk.found, walk.evidence
    poses = {new: before.poses[old] for old, new in enumerate(rows)}
    points = {new: before.points[old] for old, new in enumerate(rows)}
    places = np.argsort(rows).tolist()
    pairs = [replace(it, between=tuple(rows[row] for row in it.between)) for it in evidence.pairs]
    found = Posed(poses, points)
    evidence = Evidence(tuple(evidence.rays[place] for place in places), tuple(pairs))
    skeleton = Skeleton(ordered, frozenset(pair.between for pair in pairs[: len(WALK)]))
    motions = dict(zip((it.between for it in pairs), walk.motions.values(), strict=True))
    straight, _ = closed(found, evidence, skeleton, lambda pair: motions[pair.between])
    off = float(np.nanmedian(deviations(straight, evidence, pairs[-1])))
    assert (off < 2) == ordered


def test_a_walk_whose_loops_fit_closes_none_that_is_farther_open() -> None:
    """What its loops show of its drift counts also once these are mapped."""
    _, tight = _walk(0.001, 1.0, RETURN).close()
    assert tight < 0.1
    walk = _walk(0.03, 1.0, RETURN[:1])
    straight, drift = walk.close()
    assert drift == pytest.approx(1.0)
    assert walk.off(straight, RETURN[0]) < 2 < walk.off(walk.found, RETURN[0])
    open_, given = walk.close(drift=tight)
    assert given == tight
    assert walk.off(open_, RETURN[0]) == pytest.approx(walk.off(walk.found, RETURN[0]))


def test_poses_that_stay_do_not_change_against_each_other() -> None:
    walk = _walk(0.06, 1.0, RETURN)
    straight = walk.closed(fixed=((0, 10), (0, 20)))

    def between(poses: Posed, one: int, other: int) -> Array:
        (turn, shift), (other_turn, other_shift) = poses.poses[one], poses.poses[other]
        return np.concatenate([(other_turn @ turn.T).ravel(), other_shift - other_turn @ turn.T @ shift])

    for other in (10, 20):
        assert between(straight, 0, other) == pytest.approx(between(walk.found, 0, other), abs=1e-2)
    assert between(straight, 10, 20) == pytest.approx(between(walk.found, 10, 20), abs=1e-2)
    assert between(straight, 0, 59) != pytest.approx(between(walk.found, 0, 59), abs=1e-2)


def test_without_loops_nothing_changes() -> None:
    walk = _walk(0.1, 1.0, [])
    assert walk.closed() is walk.found
