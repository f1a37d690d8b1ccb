"""How the camera moved from one panorama to another, as their matches say: without a scale."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.distant import STILL, angles, common_rotation, direction_of_rest
from panolog.prepare.sfm.consistency.evidence import FEWEST, LIKE_OTHERS, Evidence, Pair, with_coverage
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.projection import project_to_fractions

Array = NDArray[np.float64]
_TURN = np.deg2rad(3.0)  # between a rotation and those of the two parts of a way
_RIVAL = 0.3, 0.6  # of the matches and the coverage of a geometry: another with both may be the true one
_CLEAR = 0.5  # between cosines of two geometries' continuity: less decides nothing
_ASIDE = np.deg2rad(20.0)  # of a motion from the plane of the motions of the two parts


@dataclass(frozen=True, eq=False)
class Motion:
    """The pose of the second camera in the first, without a scale: x2 = rotation @ x1 + direction."""

    rotation: Array  # (3, 3)
    direction: Array  # (3,) of length 1

    @property
    def leaving(self) -> Array:
        """(3,) the direction in which the camera moves, in axes of the first."""
        return -self.rotation.T @ self.direction

    @property
    def arriving(self) -> Array:
        """(3,) the direction in which it moves, in axes of the second."""
        return -self.direction

    def is_like(self, other: "Motion") -> bool:
        """Whether rotations and directions differ by what noise may do."""
        turned = np.trace(self.rotation @ other.rotation.T) >= 1 + 2 * np.cos(_TURN)
        return bool(turned and self.direction @ other.direction >= np.cos(_ASIDE))


class Geometries:
    """Epipolar geometries of pairs of a database, by RANSAC: the same for the same matches."""

    def __init__(self, work: Workspace, size: tuple[int, int], max_error: float, evidence: Evidence) -> None:
        """Args: size, (width, height) of panoramas; max_error, pixels from a feature to its epipolar line."""
        self._ids = work.ids()
        with pycolmap.Database.open(work.database) as database:
            self._camera = database.read_all_cameras()[0]
        self._evidence, self._error = evidence, max_error * 2 * np.pi / size[0]
        self._pixels = [project_to_fractions(rays) * size for rays in evidence.rays]
        self._options = pycolmap.TwoViewGeometryOptions()
        self._options.ransac.max_error, self._options.ransac.random_seed = max_error, 0
        self._options.compute_relative_pose = True
        self._database = work.database
        self._motions: dict[tuple[int, int], tuple[Pair, Motion | None]] = {}

    def motion(self, pair: Pair) -> Motion | None:
        """The motion from the first panorama of a pair to the second; None if its matches give none."""
        known, motion = self._motions.get(pair.between, (None, None))
        if known is None or known.matches is not pair.matches:
            motion = self._estimate(pair)[1]
            self._motions[pair.between] = pair, motion
        return motion

    def marked(self, evidence: Evidence) -> Evidence:
        """The pairs with which of their matches have moved, and the coverage of these.

        Where most have not, such as clouds, any motion fits most of them, and what fits the true one was left
        out: the geometry is then found again, in all matches.
        """
        pairs = []
        for pair in evidence.pairs:
            marked = self.mark(pair, self.motion(pair))
            if 2 * len(marked.telling) < len(marked.matches):
                whole = self._fitted(Pair(pair.between, self._matches(pair)))
                marked = max(marked, whole, key=lambda it: len(it.telling))
            pairs.append(marked)
        return Evidence(evidence.rays, tuple(with_coverage(evidence.rays, pairs)))

    def mark(self, pair: Pair, motion: Motion | None) -> Pair:
        """A pair with which of its matches its motion has moved: none without one."""
        return mark(self._evidence, pair, motion, self._error)

    def second(self, pair: Pair, least: float) -> Pair | None:
        """The pair with those of its other matches that fit one geometry; None with fewer than `least`."""
        known = {tuple(match) for match in pair.matches.tolist()}
        rest = np.array([it for it in self._matches(pair).tolist() if tuple(it) not in known], np.int64)
        if len(rest) < max(FEWEST, least):
            return None
        found = self._fitted(Pair(pair.between, rest))
        return found if len(found.matches) >= max(FEWEST, least) else None

    def _matches(self, pair: Pair) -> NDArray[np.int64]:
        """(M, 2) all matches of a pair, whatever fits."""
        one, other = (self._ids[row] for row in pair.between)
        with pycolmap.Database.open(self._database) as database:
            return np.asarray(database.read_matches(one, other), np.int64).reshape(-1, 2)

    def _fitted(self, pair: Pair) -> Pair:
        """A pair with those of its matches that fit one geometry, marked by its motion."""
        matches, motion = self._estimate(pair)
        return self.mark(replace(pair, matches=matches), motion)

    def _estimate(self, pair: Pair) -> tuple[NDArray[np.int64], Motion | None]:
        """The matches (M, 2) of a pair that fit one geometry, and its motion."""
        one, other = (self._pixels[row] for row in pair.between)
        found = pycolmap.estimate_calibrated_two_view_geometry(
            self._camera, one, self._camera, other, pair.matches.astype(np.uint32), self._options
        )
        pose, motion = found.cam2_from_cam1, None
        inliers = np.asarray(found.inlier_matches, np.int64).reshape(-1, 2)
        if pose is None:
            return inliers, None
        rotation = np.asarray(pose.rotation.matrix())
        if (length := float(np.linalg.norm(pose.translation))) > 0:
            motion = Motion(rotation, np.asarray(pose.translation) / length)
        moved = self.mark(Pair(pair.between, inliers), motion).telling
        if 2 * len(moved) >= len(inliers):
            return inliers, motion
        start, end = self._evidence.directions(pair)
        rotation = common_rotation(start, end, rotation, self._error)
        fit = angles(start @ rotation.T, end) <= STILL * self._error
        near = np.flatnonzero(~fit)
        if len(near) < FEWEST:
            return inliers, motion
        direction, fit[near] = direction_of_rest(start[near] @ rotation.T, end[near], self._error)
        if fit.sum() < len(inliers):
            return inliers, motion
        return pair.matches[fit], Motion(rotation, direction)


def mark(evidence: Evidence, pair: Pair, motion: Motion | None, error: float) -> Pair:
    """A pair with which of its matches a motion has moved, none without one, and how far.

    Args: error, radians that a feature may be off.
    """
    if motion is None:
        return replace(pair, moved=np.zeros(len(pair.matches), np.bool_), parallax=0.0)
    one, other = evidence.directions(pair)
    apart = angles(one @ common_rotation(one, other, motion.rotation, error).T, other)
    moved = apart > STILL * error
    parallax = float(np.rad2deg(np.median(apart[moved]))) if moved.any() else 0.0
    return replace(pair, moved=moved, parallax=parallax)


class Judge(Protocol):
    """What `look_again` needs of geometries."""

    def motion(self, pair: Pair) -> Motion | None:
        """The motion between the panoramas of a pair."""

    def second(self, pair: Pair, least: float) -> Pair | None:
        """The pair with the geometry of its other matches."""


def look_again(evidence: Evidence, geometries: Judge) -> Evidence:
    """Neighbours in order with the likelier of two geometries, and whether the other rivals it.

    Where houses repeat, most matches of two panoramas may fit a half turn, or a step to the next house. The
    second geometry is that of the matches that do not fit the first. If it explains about as much, the one
    that continues the motions before and after is taken; otherwise, of a pair that covers less than other
    neighbours do, the one that covers more.
    """
    near = {pair.between: pair for pair in evidence.pairs if pair.apart == 1}
    least = LIKE_OTHERS * float(np.median([pair.coverage for pair in near.values()])) if near else 0.0
    second = [geometries.second(pair, _RIVAL[0] * len(pair.matches)) for pair in near.values()]
    found = [pair for pair in second if pair is not None]
    covering = with_coverage(evidence.rays, [*evidence.pairs, *found])[len(evidence.pairs) :]
    others = {pair.between: pair for pair in covering}

    def choose(pair: Pair) -> Pair:
        other = others.get(pair.between)
        if other is None:
            return pair
        rivals = other.coverage >= _RIVAL[1] * pair.coverage
        clear = 0.0
        if rivals:
            clear = _continuity(other, near, geometries) - _continuity(pair, near, geometries)
        covers_more = pair.coverage < min(least, other.coverage)
        better = clear > 0 if abs(clear) >= _CLEAR else covers_more
        chosen, left = (other, pair) if better else (pair, other)
        return replace(chosen, rivalled=left.coverage >= _RIVAL[1] * chosen.coverage)

    return Evidence(evidence.rays, tuple(choose(pair) for pair in evidence.pairs))


def _continuity(pair: Pair, near: Mapping[tuple[int, int], Pair], geometries: Judge) -> float:
    """The cosine between the motion of a pair of neighbours and that before or after it, the lower one."""
    one, other = pair.between
    motion = geometries.motion(pair)
    if motion is None:
        return -1.0
    cosines = []
    if (before := near.get((one - 1, one))) and (there := geometries.motion(before)):
        cosines.append(float(there.arriving @ motion.leaving))
    if (after := near.get((other, other + 1))) and (there := geometries.motion(after)):
        cosines.append(float(there.leaving @ motion.arriving))
    return min(cosines, default=0.0)
