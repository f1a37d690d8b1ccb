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
_AT_ONCE = 1024  # features of the first panorama: what bounds the memory


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
    sides = [side.astype(np.float32) for side in _arcs(rays[0] @ motion.rotation.T, motion.direction)]
    bound, other = np.float32(np.sin(error)), np.ascontiguousarray(rays[1].T, np.float32)
    best = np.zeros((2, len(words[0])), np.float32)  # of each feature, and the second
    there = np.zeros(len(words[0]), np.int64)
    back, backed = np.zeros(len(words[1]), np.float32), np.full(len(words[1]), -1)
    for start in range(0, len(words[0]), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        close = words[0][part] @ words[1].T / np.float32(_SQUARE)
        across, beyond, behind = (side[part] @ other for side in sides)
        close[(np.abs(across) > bound) | (beyond < -bound) | (behind < -bound)] = 0
        rows = np.arange(len(close))
        there[part] = close.argmax(axis=1)
        best[0, part] = close[rows, there[part]]
        nearest = close.max(axis=0)
        better = nearest > back
        back[better], backed[better] = nearest[better], start + close.argmax(axis=0)[better]
        close[rows, there[part]] = 0
        best[1, part] = close.max(axis=1)
    first, second = np.arccos(np.minimum(best, 1))
    clear = (first < _FARTHEST) & (first < _RATIO * second) & (backed[there] == np.arange(len(there)))
    return np.column_stack([np.flatnonzero(clear), there[clear]])


def _arcs(far: Array, epipole: Array) -> tuple[Array, Array, Array]:
    """(N, 3) normals of the planes of arcs from directions `far` (N, 3) to `epipole`, and of both ends.

    A ray on an arc is perpendicular to the first, and on the positive side of the others.
    """
    plane = np.cross(far, epipole)
    plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-9)
    return plane, np.cross(epipole, plane), np.cross(plane, far)
