"""How one panorama stands to another by what each has points of: a similarity.

Two stretches of a walk that see the same place have points of their own of it, as far apart as the walk has
drifted. Of a match, the one panorama's point must be where the other sees it, and the other way round. With
the rotation of their motion, that gives where the second stands in the first, and how much larger the world
around it has become: four numbers, each match two equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import Posed
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.motion import Motion
from panolog.prepare.sfm.consistency.skeleton import Edge

Array = NDArray[np.float64]
Relation = tuple[Edge, Array, Array, float, float]  # of a pair: a line of `Relations`
LEAST = 8  # matches that fit a similarity, or points that two panoramas share, at least
_FIT = np.deg2rad(1.5)  # between where a point is and where it is seen, for a match that fits a similarity
_SIDE = 5  # points that each of the two panoramas has of their matches, at least
_TRIALS = 200  # of a similarity: enough where one match in seven is true
_REFITS = 6
_LEAST_WEIGHT = 0.05  # of a relation: as of a twentieth of the usual points


@dataclass(frozen=True, eq=False)
class Relations:
    """What E pairs of panoramas say of each other: similarities."""

    ends: NDArray[np.int64]  # (E, 2) places of the panoramas in the graph
    rotations: Array  # (E, 3, 3) from camera axes of the first to those of the second
    centers: Array  # (E, 3) of the second in camera axes of the first, in its units
    sizes: Array  # (E,) logarithm of how many units of the first are one of the second
    weights: Array  # (E,)

    def __getitem__(self, which: NDArray[np.bool_]) -> "Relations":
        """Some of them; which (E,)."""
        return Relations(*(it[which] for it in vars(self).values()))

    def __add__(self, other: "Relations") -> "Relations":
        """These and others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Relations(*map(np.concatenate, pairs))


def measured(found: Posed, evidence: Evidence, pair: Pair, motion: Motion | None) -> Relation | None:
    """The similarity between the panoramas of a pair, by what each has points of; None without one."""
    if motion is None:
        return None
    (turn, shift), (other_turn, other_shift) = (found.poses[row] for row in pair.between)
    start, end = (evidence.rays[row][pair.telling[:, side]] for side, row in enumerate(pair.between))
    near = found.points[pair.between[0]][pair.telling[:, 0]] @ turn.T + shift
    far = found.points[pair.between[1]][pair.telling[:, 1]] @ other_turn.T + other_shift
    one, other = np.isfinite(near[:, 0]), np.isfinite(far[:, 0])
    if min(one.sum(), other.sum()) < _SIDE:
        return None
    fit = _Fit(near[one] @ motion.rotation.T, end[one], far[other], start[other] @ motion.rotation.T)
    solution, inliers = fit.solve()
    both = np.zeros(len(start), np.bool_)
    both[np.flatnonzero(one)[inliers[: one.sum()]]] = True
    both[np.flatnonzero(other)[inliers[one.sum() :]]] = True
    if both.sum() < LEAST or 2 * both.sum() < (one | other).sum():
        return None
    size = float(np.log(solution[3]))
    return pair.between, motion.rotation, -motion.rotation.T @ solution[:3], size, float(both.sum())


class _Fit:
    """A shift t and a scale s: a + t (A, 3) are seen towards `there`, and s b - t (B, 3) towards `back`."""

    def __init__(self, a: Array, there: Array, b: Array, back: Array) -> None:
        self._a, self._there, self._b, self._back = a, there, b, back
        self._known = np.concatenate([np.cross(a, there), np.zeros_like(b)])  # what (t, s) are mapped to
        across = [np.cross(np.eye(3), it[:, None]) for it in (there, back)]
        one = np.concatenate([-across[0].transpose(0, 2, 1), np.zeros((len(a), 3, 1))], axis=2)
        other = np.concatenate([across[1].transpose(0, 2, 1), np.cross(back, b)[:, :, None]], axis=2)
        self._lines = np.concatenate([one, other])

    def solve(self) -> tuple[Array, NDArray[np.bool_]]:
        """(4,) t and s, and which of the points (A + B,) fit."""
        random = np.random.default_rng(0)
        one = random.integers(0, len(self._a), _TRIALS)
        other = len(self._a) + random.integers(0, len(self._b), _TRIALS)
        lines = np.concatenate([self._lines[one], self._lines[other]], axis=1)
        known = np.concatenate([self._known[one], self._known[other]], axis=1)
        squares = np.einsum("kij,kil->kjl", lines, lines) + 1e-12 * np.eye(4)
        tried = np.linalg.solve(squares, np.einsum("kij,ki->kj", lines, known)[..., None])[..., 0]
        best = tried[(self._off(tried) <= _FIT).sum(axis=1).argmax()]
        for _ in range(_REFITS):
            off = self._off(best[None])[0]
            weights = (off <= _FIT) / (1 + (2 * off / _FIT) ** 2)
            weights = np.sqrt(weights) / np.maximum(self._distances(best), 1e-9)
            lines = (self._lines * weights[:, None, None]).reshape(-1, 4)
            again = np.linalg.lstsq(lines, (self._known * weights[:, None]).ravel(), rcond=None)[0]
            if again[3] <= 0:
                break
            best = again
        return best, self._off(best[None])[0] <= _FIT

    def _off(self, tried: Array) -> Array:
        """(N, A + B) radians between where points are and where they are seen, for each of (N, 4)."""
        shifts, scales = tried[:, None, :3], tried[:, 3, None, None]
        there, back = self._a + shifts, scales * self._b - shifts
        cosines = np.concatenate(
            [
                (where * seen).sum(axis=2) / np.maximum(np.linalg.norm(where, axis=2), 1e-12)
                for where, seen in ((there, self._there), (back, self._back))
            ],
            axis=1,
        )
        off = np.arccos(np.clip(cosines, -1, 1))
        off[tried[:, 3] <= 0] = np.pi
        return np.asarray(off)

    def _distances(self, solution: Array) -> Array:
        """(A + B,) of the points from the panorama that sees them."""
        there, back = self._a + solution[:3], solution[3] * self._b - solution[:3]
        return np.asarray(np.linalg.norm(np.concatenate([there, back]), axis=1))


def shared_points(found: Posed, pair: Pair) -> int:
    """How many points both panoramas of a pair have."""
    one, other = (found.points[row][pair.matches[:, side]] for side, row in enumerate(pair.between))
    return int((one == other).all(axis=1).sum())


def as_posed(found: Posed, edge: Edge, weight: float) -> Relation:
    """What the poses say of a pair."""
    (one, start), (other, end) = (found.poses[row] for row in edge)
    turn = other @ one.T
    return edge, turn, turn.T @ (turn @ start - end), 0.0, weight


def relations_of(lines: Sequence[Relation | None], place: dict[int, int], usual: float) -> Relations:
    """The relations that are known, of panoramas at these places; usual, points, whose weight is 1."""
    known = [it for it in lines if it is not None]
    ends = np.array([[place[row] for row in it[0]] for it in known], np.int64).reshape(-1, 2)
    rotations, centers = (np.array([it[k] for it in known]) for k in (1, 2))
    sizes, weights = (np.array([it[k] for it in known], np.float64) for k in (3, 4))
    weights = np.maximum(weights / usual, _LEAST_WEIGHT)
    return Relations(ends, rotations.reshape(-1, 3, 3), centers.reshape(-1, 3), sizes, weights)
