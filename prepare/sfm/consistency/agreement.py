"""Whether the matches of a pair agree with poses and points that were found without it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, directions
from panolog.prepare.sfm.consistency.motion import Motion

Array = NDArray[np.float64]
FEW = 10  # directions that can be compared: below them a pair is not judged
_SHRUNK = 0.001  # of the usual distance of points: a flight and a room differ by a hundred times


@dataclass(frozen=True, eq=False)
class Posed:
    """A reconstruction, as far as pairs are compared with it."""

    poses: dict[int, tuple[Array, Array]]  # of rows with a pose: world-to-camera (3, 3) and (3,)
    points: dict[int, Array]  # of these rows (N, 3) the point of each feature, NaN without one

    def centers(self, rows: Iterable[int]) -> Array:
        """(K, 3) where the panoramas of these rows stand."""
        return np.array([-turn.T @ shift for turn, shift in map(self.poses.__getitem__, rows)])

    def shrunk(self) -> set[int]:
        """The rows whose points are so near that all around them is one point for the others.

        Nothing contradicts that: where a step seems to lead back, what follows fits if it is small enough.
        """
        rows = [row for row, points in self.points.items() if np.isfinite(points).any()]
        away = [self.points[row] - center for row, center in zip(rows, self.centers(rows), strict=True)]
        distances = np.array([np.nanmedian(np.linalg.norm(it, axis=1)) for it in away])
        near = distances < _SHRUNK * np.median(distances) if rows else []
        return {rows[place] for place in np.flatnonzero(near)}


def posed(model: pycolmap.Reconstruction, ids: Sequence[int]) -> Posed:
    """The poses and points of a model whose images have the database's `ids`, one for each row."""
    where = {number: point.xyz for number, point in model.points3D.items()}
    nothing = np.full(3, np.nan)
    poses, points = {}, {}
    registered = set(model.reg_image_ids())
    for row, number in enumerate(ids):
        if number in registered:
            image = model.image(number)
            pose = image.cam_from_world()
            poses[row] = (np.asarray(pose.rotation.matrix()), np.asarray(pose.translation))
            points[row] = np.array(
                [where[it.point3D_id] if it.has_point3D() else nothing for it in image.points2D]
            ).reshape(-1, 3)
    return Posed(poses, points)


def deviations(found: Posed, evidence: Evidence, pair: Pair) -> Array:
    """(M,) degrees between where a match is seen and where its point should be, NaN where no point is known.

    Of a match whose features both have a point, the larger of the two.
    """
    off = np.full((2, len(pair.matches)), np.nan)
    for side, (row, other) in enumerate((pair.between, pair.between[::-1])):
        if row in found.points and other in found.poses:
            points = found.points[row][pair.matches[:, side]]
            rotation, shift = found.poses[other]
            there = points @ rotation.T + shift
            seen = evidence.rays[other][pair.matches[:, 1 - side]]
            cosine = (there * seen).sum(axis=1) / np.linalg.norm(there, axis=1)
            off[side] = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    larger: Array = np.fmax(off[0], off[1])
    return larger


def judged(pair: Pair, off: Array) -> NDArray[np.bool_]:
    """(M,) which deviations of the matches of a pair are known and say where its panoramas stand."""
    known = np.isfinite(off)
    return known if pair.moved is None else known & pair.moved


def agrees(evidence: Evidence, pair: Pair, off: Array, bound: float) -> bool | None:
    """Whether deviations (M,) of the matches of a pair, in degrees, are below a bound; None if few are known.

    Most of them, or those all around: copies of houses may be more, but are not everywhere. Where most are
    not, but these are few, neither is known.
    """
    known = judged(pair, off)
    if known.sum() < FEW:
        return None
    fit, rays = known & (off <= bound), evidence.rays[pair.between[0]][pair.matches[:, 0]]
    rest = known & ~fit
    if fit.sum() >= rest.sum():
        return True
    if rest.sum() < FEW:
        return None
    return bool(fit.sum() >= FEW and directions(rays[fit]) >= directions(rays[rest]))


def has_moved(found: Posed, between: tuple[int, int], motion: Motion | None) -> bool:
    """Whether a reconstruction has a motion between two panoramas; true if that is unknown."""
    if motion is None or not set(between) <= found.poses.keys():
        return True
    known = motion_between(found, between)
    return known is None or motion.is_like(known)


def motion_between(found: Posed, between: tuple[int, int]) -> Motion | None:
    """The motion from one panorama of a reconstruction to another; None if both are at one place."""
    (one, start), (other, end) = (found.poses[row] for row in between)
    rotation = other @ one.T
    shift = end - rotation @ start
    length = float(np.linalg.norm(shift))
    return None if length == 0 else Motion(rotation, shift / length)


def apart(found: Posed, between: tuple[int, int]) -> float:
    """How far two panoramas of a reconstruction are from each other, in its units."""
    one, other = found.centers(between)
    return float(np.linalg.norm(one - other))
