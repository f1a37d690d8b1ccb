"""How the light of two lenses differs: in brightness as a whole, and by its fall-off towards the rim.

Two pictures of one thing differ in its values by a gain of these pictures, and by the fall-off at the angles
at which it is seen. In the overlap both lenses show the same directions, one of them nearer to its rim: that
says how steep the fall-off is there, so that no seam remains. How it is further in is known from points that
are found again in the next picture, at another angle. Without such points the logarithm is taken to be
quadratic, as that of cos⁴ nearly is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from panolog.prepare.stitching.calibrate import EDGE, Lenses, ring, show
from panolog.prepare.stitching.circles import Picture
from panolog.prepare.stitching.lenses import Array, Pair

_COLUMNS = 1024  # of the ring in which both lenses are compared
_DARK, _BRIGHT = 16, 240  # of 255: outside of these, brightness is cut off
_MOST = 4.0  # by which two lenses differ in brightness, at most
_TERMS = 3  # of `Pair.fall`
_POINTS = 2000  # of a picture, at most
_SURE = 0.75  # of the distance of the second best match that the best has, at most
_FEWEST, _MANY = 100, 500  # points that two pictures have in common if they count, and if they count fully
_PATCH = 2.0  # pixels, σ, over which the values at a point are averaged
_SAME = 0.02  # of the values: smaller differences count alike
_PRIOR = 10.0  # against terms that only points within the circles can tell from the first
_STEEPEST = 1.4  # the terms together, at most: a quarter of the light at the rim
_ROUNDS = 10


@dataclass(frozen=True)
class _Common:
    """What two pictures of lenses have in common, in one channel."""

    differs: Array  # (N,) logarithm of the values of the second over those of the first
    terms: Array  # (N, _TERMS) what each term of `Pair.fall` adds to that


def gains(pair: Pair, both: Lenses) -> Array:
    """(3,) by which the first lens is darker than the second one, in the median of what both show."""
    found = np.ones(3)
    for channel, it in enumerate(_overlap(pair, both)):
        if len(it.differs):
            differs = it.differs - it.terms[:, : len(pair.fall)] @ np.array(pair.fall)
            found[channel] = np.clip(np.exp(np.median(differs)), 1 / _MOST, _MOST)
    return found


def fall_off(pair: Pair, pictures: Sequence[Lenses]) -> tuple[float, ...]:
    """`Pair.fall` with which what pictures have in common differs by a gain of the two alone.

    Least absolute deviations, as shadows, reflections and what is near differ anyway. No term is negative, so
    light falls off all the way.

    Args: pictures, of which those that follow each other may show the same things.
    """
    points = [[_Points.of(pair, side, both[side]) for side in range(2)] for both in pictures]
    common = [it for both in pictures for it in _overlap(pair, both)]
    common += [it for two in pairwise(points) for each in product(*two) for it in _again(*each)]
    common = [it for it in common if len(it.differs) >= _FEWEST]
    found = np.zeros(_TERMS)
    prior = np.diag([0.0, *[_PRIOR] * (_TERMS - 1)])
    for _ in range(_ROUNDS):
        rows, values = [prior], [np.zeros(_TERMS)]
        for it in common:
            off = it.differs - it.terms @ found
            weight = min(1.0, _MANY / len(off)) / np.maximum(np.abs(off - np.median(off)), _SAME)
            root, total = np.sqrt(weight), weight.sum()
            rows.append(root[:, None] * (it.terms - weight @ it.terms / total))
            values.append(root * (it.differs - weight @ it.differs / total))
        found = nnls(np.concatenate(rows), np.concatenate(values))[0]
    found *= _STEEPEST / max(found.sum(), _STEEPEST)
    return tuple(round(float(it), 4) for it in found)


def _overlap(pair: Pair, both: Lenses) -> Iterator[_Common]:
    """What both lenses show of the same directions."""
    directions = ring(_COLUMNS, pair.reach - np.pi / 2)
    (one, there), (other, there_too) = (show(pair, side, both[side], directions) for side in range(2))
    common = there & there_too
    angles = [lens.project(directions)[1][common] / pair.reach for lens in pair.lenses]
    return _in_channels(one[common], other[common], angles[0], angles[1])


def _in_channels(one: Picture, other: Picture, angle: Array, angle_of_other: Array) -> Iterator[_Common]:
    """What two pictures have in common in each channel, where brightness is not cut off.

    Args: values (N, 3) of the same things in both, and their angles (N,) over the reach.
    """
    powers = 2 * np.arange(1, _TERMS + 1)
    terms = angle[:, None] ** powers - angle_of_other[:, None] ** powers
    for a, b in zip(one.T.astype(np.float64), other.T.astype(np.float64), strict=True):
        used = (np.minimum(a, b) > _DARK) & (np.maximum(a, b) < _BRIGHT)
        yield _Common(np.log(b[used] / a[used]), terms[used])


@dataclass(frozen=True)
class _Points:
    """Points that a lens shows."""

    marks: NDArray[np.float32]  # (N, 128) by which they are found again
    values: Picture  # (N, 3)
    angles: Array  # (N,) from the axis, over the reach

    @staticmethod
    def of(pair: Pair, side: int, picture: Picture) -> "_Points":
        """The points of a picture that SIFT finds."""
        lens = pair.lenses[side]
        found, marks = cv2.SIFT_create(_POINTS).detectAndCompute(picture, None)  # type: ignore[attr-defined]
        at = np.array([it.pt for it in found]).reshape(-1, 2)
        ahead = (lens.directions(at + 0.5) @ lens.rotation.T)[:, 2]
        angles = np.arccos(np.clip(ahead, -1, 1))
        kept = angles < pair.reach - 2 * EDGE
        x, y = np.rint(at[kept]).astype(int).T
        smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), _PATCH), np.uint8)
        described = np.zeros((0, 128), np.float32) if marks is None else np.asarray(marks, np.float32)
        return _Points(described[kept], smooth[y, x], angles[kept] / pair.reach)


def _again(one: _Points, other: _Points) -> Iterator[_Common]:
    """What two pictures show of the same points."""
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.marks, other.marks, k=2) if len(one.marks) else []
    sure = [it[0] for it in matches if len(it) == 2 and it[0].distance < _SURE * it[1].distance]
    rows, found = [it.queryIdx for it in sure], [it.trainIdx for it in sure]
    return _in_channels(one.values[rows], other.values[found], one.angles[rows], other.angles[found])
