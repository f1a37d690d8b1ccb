"""Faces between blocks, and planes within a block to compare them with, in contracted space.

Only the bounds of cells are used, so any partition into boxes has faces.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

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
_PART = 1_000  # faces whose cameras are found at once
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


def planes_between(grid: Cells) -> tuple[Plane, ...]:
    """All faces between two blocks of a grid, by `below`, axis and `above`."""
    bounds = [grid.bounds(block) for block in range(grid.count)]
    lower, upper = (np.array(corners) for corners in zip(*bounds, strict=True))  # (B, 3)
    found = []
    for axis in range(3):
        along = [other for other in range(3) if other != axis]
        for at in np.intersect1d(lower[:, axis], upper[:, axis]):
            belows, aboves = np.flatnonzero(upper[:, axis] == at), np.flatnonzero(lower[:, axis] == at)
            meet = np.full((len(belows), len(aboves)), True)
            for other in along:
                meet &= lower[belows, other][:, None] < upper[aboves, other]
                meet &= lower[aboves, other] < upper[belows, other][:, None]
            for i, j in np.argwhere(meet):
                below, above = int(belows[i]), int(aboves[j])
                low, high = np.maximum(lower[below], lower[above]), np.minimum(upper[below], upper[above])
                found.append(_face(below, above, axis, float(at), low, high))
    return tuple(sorted(found, key=lambda face: (face.below, face.axis, face.above)))


def seams_of(plan: Plan) -> tuple[Plane, ...]:
    """The faces that are near cameras on both sides, with a trained block on either."""
    trained = [face for face in planes_between(plan.grid) if plan.trained[[face.below, face.above]].any()]
    found: list[Plane] = []
    for faces in _parts(trained):
        index, cameras, _ = _near(plan, faces)
        below, above = (set(index[side].tolist()) for side in _sides(plan, faces, index, cameras))
        found += [face for i, face in enumerate(faces) if i in below and i in above]
    return tuple(found)


def most_seen(plan: Plan, faces: Sequence[Plane], most: int) -> tuple[Plane, ...]:
    """The `most` of some faces that are near most cameras, in order."""
    near = [n for part in _parts(faces) for n in np.bincount(_near(plan, part)[0], minlength=len(part))]
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
    faces = (face,)
    index, near, distances = _near(plan, faces)
    along = np.delete(plan.centers[near], face.axis, axis=1)
    sides = _sides(plan, faces, index, near)
    chosen = [near[_spread(along, distances, np.flatnonzero(side).tolist())].tolist() for side in sides]
    return tuple(k for side in chosen for k in side) if all(chosen) else ()


def views_at(plan: Plan, face: Plane, checks: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The rows of Scene.panoramas that train what is near a face, and those on which that is checked.

    They train one of its blocks and stand near it. Of others, every eighth does not train but checks, at most
    `checks` of them, the nearest ones first; as many that train check too.
    """
    assigned = np.union1d(*map(plan.assignment.cameras_of, (face.below, face.above)))
    _, near, distances = _near(plan, (face,))
    order = near[np.argsort(distances, kind="stable")]
    order = order[np.isin(order, assigned)]
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


def _parts(faces: Sequence[Plane]) -> Iterator[Sequence[Plane]]:
    """The faces in parts whose near cameras take little memory."""
    return (faces[first : first + _PART] for first in range(0, len(faces), _PART))


_Near = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]


def _near(plan: Plan, faces: Sequence[Plane]) -> _Near:
    """The cameras that are near faces, by face and row: (N,) faces, rows of `plan`, and distances."""
    low, high = in_box(faces, plan.aabb)
    farthest = _FARTHEST * plan.baseline
    around = farthest + np.linalg.norm(high - low, axis=1) / 2  # of the middle of the face
    found = plan.tree.query_ball_point((low + high) / 2, around * (1 + 1e-9), return_sorted=True)
    index = np.repeat(np.arange(len(faces)), [len(rows) for rows in found])
    rows = np.fromiter(chain.from_iterable(found), np.int64, len(index))
    distances = distances_from(plan.centers[rows], low[index], high[index])
    near = distances <= farthest
    return index[near], rows[near], distances[near]


def _sides(
    plan: Plan, faces: Sequence[Plane], index: NDArray[np.int64], cameras: NDArray[np.int64]
) -> list[NDArray[np.bool_]]:
    """(N,) which cameras are in the block below their face and below it, and which likewise above.

    Args: index (N,) of each camera's face; cameras (N,) rows of `plan`.
    """
    axis, at = np.array([face.axis for face in faces], int), np.array([face.at for face in faces])
    blocks = np.array([(face.below, face.above) for face in faces], int)[index]
    places = contract(plan.centers[cameras], plan.aabb)
    over = places[np.arange(len(index)), axis[index]] >= at[index]
    own = plan.camera_blocks[cameras]
    return [(own == blocks[:, above]) & (over == bool(above)) for above in (0, 1)]


def in_box(faces: Sequence[Plane], aabb: Aabb) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(F, 3) lower and upper corners, in world units, of the parts of faces that are in the AABB."""
    corners = np.array([(face.lower, face.upper) for face in faces]).clip(*_BOX)
    low, high = (aabb.lower + (corners[:, end] - _BOX[0]) * 4 * aabb.half for end in (0, 1))
    return low, high


def distances_from(
    positions: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) distances of positions (N, 3) from boxes with these lower and upper corners (N, 3)."""
    distances: NDArray[np.float64] = np.linalg.norm(positions - positions.clip(low, high), axis=1)
    return distances


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
