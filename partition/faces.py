"""Faces between blocks, and planes within a block to compare them with, in contracted space.

Only the bounds of cells are used, so any partition into boxes has faces.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb
from panolog.partition.cells import Cells
from panolog.partition.contraction import contract
from panolog.partition.plan import Plan

_BOX = (0.25, 0.75)  # the AABB in contracted space
_CAMERAS = 3  # on each side of a face
_FARTHEST = 10.0  # baselines from a face at which a camera still counts as near
_AWAY = 3.0  # baselines from a face at which a block is within itself
_PAIR = 4.0  # baselines between two cameras up to which a viewer may move from one to the other
_HELD = 8  # of so many cameras near a face one does not train what is near it but checks it
_FEWEST = 4  # cameras of a block that has planes within
_QUARTILES = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Plane:
    """An axis-aligned rectangle in contracted space between two blocks, or within one."""

    below: int  # block at lower coordinates
    above: int  # block at higher coordinates; `below` itself for a plane within it
    axis: int  # that it is perpendicular to
    at: float  # its coordinate on that axis
    lower: tuple[float, float, float]  # corners; on `axis` both are `at`
    upper: tuple[float, float, float]

    def offsets(self, points: ArrayLike, aabb: Aabb) -> NDArray[np.float64]:
        """(N,) how far world points (N, 3) are above the face; NaN outside of it, seen along its axis.

        In world units as within the AABB; outside of it the contraction makes them smaller.

        Raises ValueError if a coordinate is not finite.
        """
        contracted = contract(points, aabb)
        others = [axis for axis in range(3) if axis != self.axis]
        low, high = np.array(self.lower)[others], np.array(self.upper)[others]
        outside = ((contracted[:, others] < low) | (contracted[:, others] >= high)).any(axis=1)
        offsets = (contracted[:, self.axis] - self.at) * 4 * aabb.half[self.axis]
        return np.where(outside, np.nan, offsets)

    def distances(self, points: ArrayLike, aabb: Aabb) -> NDArray[np.float64]:
        """(N,) distances of world points (N, 3) from the part of the face in the AABB, in world units."""
        low, high = (
            aabb.lower + (np.clip(corner, *_BOX) - _BOX[0]) * 4 * aabb.half
            for corner in (self.lower, self.upper)
        )
        positions = np.asarray(points, np.float64)
        distances: NDArray[np.float64] = np.linalg.norm(positions - positions.clip(low, high), axis=1)
        return distances


def planes_between(grid: Cells) -> tuple[Plane, ...]:
    """All faces between two blocks of a grid, by `below`, axis and `above`."""
    bounds = [grid.bounds(block) for block in range(grid.count)]
    lower, upper = (np.array(corners) for corners in zip(*bounds, strict=True))  # (B, 3)
    found = []
    for block, axis in np.ndindex(grid.count, 3):
        low, high = np.maximum(lower, lower[block]), np.minimum(upper, upper[block])
        touches = lower[:, axis] == upper[block, axis]
        along = [other for other in range(3) if other != axis]
        for above in np.flatnonzero(touches & (low < high)[:, along].all(axis=1)):
            at = float(upper[block, axis])
            found.append(_face(block, int(above), axis, at, low[above], high[above]))
    return tuple(found)


def seams_of(plan: Plan) -> tuple[Plane, ...]:
    """The faces that are near cameras on both sides, with a trained block on either."""
    trained = (face for face in planes_between(plan.grid) if plan.trained[[face.below, face.above]].any())
    return tuple(face for face in trained if cameras_at(plan, face))


def most_seen(plan: Plan, faces: Sequence[Plane], most: int) -> tuple[Plane, ...]:
    """Of some faces the `most` that are near most cameras, in order."""
    near = [len(_near(plan, face)[0]) for face in faces]
    chosen = sorted(range(len(faces)), key=lambda i: (-near[i], i))[:most]
    return tuple(faces[i] for i in sorted(chosen))


def planes_within(plan: Plan, block: int, axis: int) -> tuple[Plane, ...]:
    """Planes through a block, parallel to its faces on an axis, with cameras around them.

    They are at the quartiles of its cameras' coordinates, those left out that are near its faces.
    """
    lower, upper = plan.grid.bounds(block)
    own = contract(plan.centers[plan.camera_blocks == block], plan.aabb)[:, axis]
    if len(own) < _FEWEST:
        return ()
    away = _AWAY * plan.baseline / (4 * plan.aabb.half[axis])
    places = [float(at) for at in np.quantile(own, _QUARTILES)]
    inside = (at for at in places if lower[axis] + away <= at <= upper[axis] - away)
    return tuple(_face(block, block, axis, at, lower, upper) for at in sorted(set(inside)))


def cameras_at(plan: Plan, face: Plane) -> tuple[int, ...]:
    """The rows of `plan` of the cameras that see a face best: up to three on each side, in its blocks.

    The nearest ones, and along a long face some far from these. None unless there are cameras on both sides.
    """
    offsets = contract(plan.centers, plan.aabb)[:, face.axis] - face.at
    sides = [
        np.flatnonzero((plan.camera_blocks == block) & ((offsets >= 0) == above))
        for block, above in ((face.below, False), (face.above, True))
    ]
    near, distances = _near(plan, face)
    along = np.delete(plan.centers, face.axis, axis=1)
    chosen = [_spread(along, distances, np.intersect1d(side, near).tolist()) for side in sides]
    return tuple(k for side in chosen for k in side) if all(chosen) else ()


def views_at(plan: Plan, face: Plane, checks: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The rows of Scene.panoramas that train what is near a face, and those on which that is checked.

    They train one of its blocks and stand near it. Of others, every eighth does not train but checks, at most
    `checks` of them, the nearest ones first; as many that train check too.
    """
    assigned = np.union1d(*map(plan.assignment.cameras_of, (face.below, face.above)))
    near, distances = _near(plan, face)
    training = np.intersect1d(near, assigned)
    order = training[np.argsort(distances[training], kind="stable")]
    held = order[_HELD // 2 :: _HELD][:checks]
    trained = np.setdiff1d(order, held)
    nearest = [k for k in order if k not in held][: len(held)]
    rows = np.array(plan.rows)
    return tuple(rows[trained].tolist()), tuple(rows[[*held, *nearest]].tolist()) if len(held) else ()


def between(plan: Plan, face: Plane, cameras: Sequence[int]) -> list[tuple[int, NDArray[np.float64]]]:
    """Positions between the cameras below a face and the nearest ones above it, each with the camera below.

    Args: cameras, as `cameras_at` returns them. Cameras far from each other have none between them.
    """
    above = np.flatnonzero(plan.camera_blocks == face.above)
    found: dict[tuple[int, int], NDArray[np.float64]] = {}
    for k in cameras:
        if plan.camera_blocks[k] == face.below:
            distances = np.linalg.norm(plan.centers[above] - plan.centers[k], axis=1)
            nearest = int(above[np.argmin(distances)])
            if distances.min() <= _PAIR * plan.baseline:
                found[k, nearest] = (plan.centers[k] + plan.centers[nearest]) / 2
    return [(k, place) for (k, _), place in found.items()]


def _near(plan: Plan, face: Plane) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The rows of `plan` of the cameras that are near a face, in order, and the distances (K,) of all."""
    distances = face.distances(plan.centers, plan.aabb)
    return np.flatnonzero(distances <= _FARTHEST * plan.baseline), distances


def _spread(along: NDArray[np.float64], distances: NDArray[np.float64], cameras: Sequence[int]) -> list[int]:
    """The nearest of some cameras, then those that are farther from the chosen ones than from the face.

    Args: along (K, 2) positions along the face; distances (K,) from it; cameras to choose from.
    """
    chosen: list[int] = []
    while len(chosen) < min(_CAMERAS, len(cameras)):
        rest = [k for k in cameras if k not in chosen]
        gain = -distances[rest]
        if chosen:
            gain += np.linalg.norm(along[rest][:, None] - along[chosen], axis=2).min(axis=1)
        chosen.append(rest[int(np.argmax(gain))])
    return chosen


def _face(
    below: int, above: int, axis: int, at: float, lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> Plane:
    corners = []
    for corner in (lower, upper):
        place = corner.tolist()
        place[axis] = at
        corners.append((place[0], place[1], place[2]))
    return Plane(below, above, axis, at, corners[0], corners[1])
