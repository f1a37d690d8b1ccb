"""Matches of two panoramas whose motion is known: more than matching finds without it.

A feature's counterpart lies on the arc from where it would be if it were infinitely far to where the first
camera is seen. A feature that has many counterparts on the whole sphere, as a window does, often has one
there. Where a walk takes long steps, these matches hold it together.
"""

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.motion import Motion
from panolog.prepare.sfm.workspace import Workspace

Array = NDArray[np.float64]
_RATIO, _FARTHEST = 0.8, 0.7  # of the second nearest; radians between descriptors: COLMAP's own bounds
_SQUARE = 512.0**2  # of the length of COLMAP's descriptors
_AT_ONCE = 1024  # features of the first panorama, or pairs of features: what bounds the memory


class Guide:
    """Finds matches along motions, between the panoramas of a database."""

    def __init__(self, work: Workspace, rays: Sequence[Array], error: float) -> None:
        """Args: rays, of each panorama (N, 3); error, radians that a feature may be off its arc."""
        self._work, self._ids, self._rays, self._error = work, work.ids(), rays, error

    def along(self, between: tuple[int, int], motion: Motion) -> NDArray[np.int64]:
        """(M, 2) rows of features that match, each the other's best on its arc."""
        with pycolmap.Database.open(self._work.database) as database:
            words = [
                np.asarray(database.read_descriptors(self._ids[row]).data, np.float32) for row in between
            ]
        one, other = (self._rays[row] for row in between)
        return match_along(words, (one, other), motion, self._error)


def match_along(
    words: Sequence[NDArray[np.float32]], rays: Sequence[Array], motion: Motion, error: float
) -> NDArray[np.int64]:
    """(M, 2) rows of features that match along a motion.

    Args: words, of both panoramas (N, 128) descriptors of length 512; rays (N, 3); error in radians.
    """
    if min(map(len, words)) == 0:
        return np.empty((0, 2), np.int64)
    near = _on_arcs(rays[0] @ motion.rotation.T, motion.direction, rays[1], np.sin(error))
    close = np.concatenate(
        [
            # sums of whole numbers below 2^24: exact in any order
            np.einsum("ij,ij->i", words[0][part[:, 0]], words[1][part[:, 1]])
            for part in np.split(near, range(_AT_ONCE, len(near), _AT_ONCE))
        ]
    )
    (first, second), there = _nearest(near, close, len(words[0]))
    _, back = _nearest(near[:, ::-1], close, len(words[1]))
    first, second = (np.arccos(np.minimum(side / _SQUARE, 1)) for side in (first, second))
    clear = (first < _FARTHEST) & (first < _RATIO * second)
    rows = np.flatnonzero(clear)
    rows = rows[back[there[rows]] == rows]
    return np.column_stack([rows, there[rows]])


def _on_arcs(far: Array, epipole: Array, rays: Array, bound: float) -> NDArray[np.int64]:
    """(P, 2) rows of the arcs from directions `far` (N, 3) to `epipole`, and of the rays (M, 3) on them."""
    plane, after, before = (side.astype(np.float32) for side in _arcs(far, epipole))
    rays, found = rays.astype(np.float32), [np.empty((0, 2), np.int64)]
    for start in range(0, len(far), _AT_ONCE):
        rows, there = np.nonzero(np.abs(plane[start : start + _AT_ONCE] @ rays.T) <= bound)
        rows += start
        least = [np.einsum("ij,ij->i", side[rows], rays[there]) >= -bound for side in (after, before)]
        found.append(np.column_stack([rows, there])[np.logical_and(*least)])
    return np.concatenate(found)


def _nearest(
    near: NDArray[np.int64], close: NDArray[np.float32], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """How close (2, N) the two closest of `count` features are, 0 without, and which (N,) is closest, or -1.

    Args: near (P, 2), pairs of features, by the rows of those and of their counterparts; close (P,).
    """
    order = np.lexsort((near[:, 1], -close, near[:, 0]))
    rows, there = near[order].T
    best, which = np.zeros((2, count), np.float32), np.full(count, -1)
    begin = np.flatnonzero(np.diff(rows, prepend=-1))
    best[0, rows[begin]], which[rows[begin]] = close[order][begin], there[begin]
    again = begin[np.diff(begin, append=len(rows)) > 1] + 1
    best[1, rows[again]] = close[order][again]
    return best, which


def _arcs(far: Array, epipole: Array) -> tuple[Array, Array, Array]:
    """(N, 3) normals of the planes of arcs from directions `far` (N, 3) to `epipole`, and of both ends.

    A ray on an arc is perpendicular to the first, and on the positive side of the others.
    """
    plane = np.cross(far, epipole)
    plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-9)
    return plane, np.cross(epipole, plane), np.cross(plane, far)
