"""Finds the lenses of a camera from its pictures alone: from the circles, and from what both lenses show.

The overlap is a ring around the camera. Points of it are followed from one lens into the other, in several
pictures, and the lenses are those in which they point in the same directions, most of them: what is near does
not, because the lenses are some centimetres apart. The ring alone does not say everything, such as the scale
within the circles; there both lenses are taken to be alike, centred in their circles, and nearly equidistant
(r = f θ), as these lenses are made.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from panolog.prepare.stitching.circles import Circle, Picture, find_circle
from panolog.prepare.stitching.lenses import Array, Lens, Pair

Lenses = tuple[Picture, Picture]  # the pictures of both, (H, W, 3) each

_REACHES = np.deg2rad(np.arange(92.5, 106.0, 0.5))  # from the axis to the edge of a circle
_COARSE = 720  # columns of the ring in which the lenses are first turned against each other
_COARSE_HALF = np.deg2rad(4.0)  # of its rows, from the seam
_FINEST = 8192  # columns of the ring in which points are followed
EDGE = np.deg2rad(0.7)  # at the edge of a circle that is dark and blurred
_ROUNDS = 5
_CORNERS = 800  # points of a picture, at most
_FEWEST, _SECTORS, _FEWEST_SECTORS = 60, 12, 7  # points in all, and parts of the ring that have some
_PLAIN = 4.0  # of 255: standard deviation of what has no texture
_BACK = 0.7  # pixels of the ring that a point may be off when it is followed back
_NOISE = 0.3  # pixels of a lens: what points are off, where they are right
_CENTRED = 0.004  # of the radius: how far centres may be from those of their circles (σ, as all of these)
_ALIKE = 0.001  # difference of the scales, against that of the circles
_BENT, _BENT_ALIKE = 2e-3, 4e-4  # `Lens.edge`, and its difference between the two
AGREED = np.deg2rad(0.5)  # what most points of a picture may be off


class OverlapError(ValueError):
    """Why what both lenses show does not determine them."""


@dataclass(frozen=True)
class Points:
    """Points of the overlap in the pictures of both lenses."""

    one: Array  # (N, 2) pixels
    other: Array

    def apart(self, pair: Pair) -> Array:
        """(N, 3) difference of the two directions, in radians."""
        one, other = pair.lenses
        return one.directions(self.one) - other.directions(self.other)


def calibrate(pictures: Sequence[Lenses]) -> Pair:
    """The lenses of a camera with which these pictures were made, all of one size.

    Raises:
        CircleError: the pictures do not show a whole circle each.
        OverlapError: there is too little in what both lenses show.
    """
    circles = [find_circle([both[side] for both in pictures]) for side in range(2)]
    pair = _first_guess(pictures, circles)
    radii = (circles[0].radius, circles[1].radius)
    for _ in range(_ROUNDS):
        points = _joined([follow(pair, both) for both in pictures])
        _require_spread(points, pair)
        pair = _fitted(pair, points, circles)
        reach = min(_reach(lens, radius) for lens, radius in zip(pair.lenses, radii, strict=True))
        pair = replace(pair, reach=reach)
    apart = np.linalg.norm(_joined([follow(pair, both) for both in pictures]).apart(pair), axis=1)
    pair = replace(pair, error=round(float(np.rad2deg(np.median(apart))), 4))
    if np.median(apart) > AGREED:
        raise OverlapError("what both lenses show does not fit together; it may be too near to the camera")
    return pair


def disagreement(pair: Pair, both: Lenses) -> float | None:
    """How far apart most points of one picture are in degrees; None where too few can be followed."""
    points = follow(pair, both)
    if len(points.one) < _FEWEST // 4:
        return None
    return float(np.rad2deg(np.median(np.linalg.norm(points.apart(pair), axis=1))))


def ring(columns: int, half: float) -> Array:
    """(rows, columns, 3) directions around the seam, up to `half` radians before and behind it."""
    rows = max(4, round(half * columns / np.pi))
    ahead = (0.5 - (np.arange(rows) + 0.5) / rows)[:, None] * 2 * half
    around = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    parts = np.cos(ahead) * np.cos(around), np.cos(ahead) * np.sin(around), np.sin(ahead) + 0 * around
    return np.stack(parts, axis=-1)


def show(pair: Pair, side: int, picture: Picture, directions: Array) -> tuple[Picture, NDArray[np.bool_]]:
    """What a lens shows in directions (..., 3): pixels of its picture, and where there is something."""
    pixels, angle = pair.lenses[side].project(directions)
    maps = (pixels[..., 0] - 0.5).astype(np.float32), (pixels[..., 1] - 0.5).astype(np.float32)
    shown = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(shown, np.uint8), pair.shows(pixels, angle, EDGE)


def follow(pair: Pair, both: Lenses) -> Points:
    """Points of one picture that both lenses show, by optical flow in the ring."""
    columns = min(_FINEST, round(2 * np.pi * pair.lenses[0].focal / 4) * 4)
    half = pair.reach - np.pi / 2
    directions = ring(columns, half)
    extended = np.concatenate([directions, directions[:, : columns // 32]], axis=1)  # over the beginning
    one, there = show(pair, 0, _grey(both[0]), extended)
    other, there_too = show(pair, 1, _grey(both[1]), extended)
    common = there & there_too
    (one, textured), (other, _) = (_evened(it, common) for it in (one, other))
    corners = cv2.goodFeaturesToTrack(one, _CORNERS, 0.03, 5, mask=(common & textured).astype(np.uint8))
    if corners is None:
        return Points(np.empty((0, 2)), np.empty((0, 2)))
    found, good = _flow(one, other, np.asarray(corners, np.float32))
    back, good_back = _flow(other, one, found)
    kept = good & good_back & (np.linalg.norm(back - corners, axis=2)[:, 0] < _BACK)
    start, end = (it[kept, 0].astype(np.float64) + 0.5 for it in (corners, found))
    seen = [_directions(at, columns, len(directions), half) for at in (start, end)]
    pixels = [lens.project(rays) for lens, rays in zip(pair.lenses, seen, strict=True)]
    valid = np.logical_and(*(pair.shows(*it, EDGE / 2) for it in pixels))
    return Points(pixels[0][0][valid], pixels[1][0][valid])


def _flow(
    one: Picture, other: Picture, at: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(N, 1, 2) where points (N, 1, 2) of one picture are in the other, and (N,) whether they are."""
    where: Any = cv2.calcOpticalFlowPyrLK(one, other, at, at.copy(), winSize=(17, 17), maxLevel=2)
    return np.asarray(where[0], np.float32), np.asarray(where[1])[:, 0] > 0


def _grey(picture: Picture) -> Picture:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def _directions(at: Array, columns: int, rows: int, half: float) -> Array:
    """(N, 3) directions at places (N, 2) of the ring."""
    around, ahead = at[:, 0] / columns * 2 * np.pi, (0.5 - at[:, 1] / rows) * 2 * half
    return np.column_stack([np.cos(ahead) * np.cos(around), np.cos(ahead) * np.sin(around), np.sin(ahead)])


def _evened(grey: Picture, common: NDArray[np.bool_]) -> tuple[Picture, NDArray[np.bool_]]:
    """A picture of the ring with the same brightness and contrast all over, and where that is no noise."""
    values = grey.astype(np.float32)
    inside = common.astype(np.float32)
    share = np.maximum(cv2.blur(inside, (41, 21)), 1e-3)
    away = (values - cv2.blur(values * inside, (41, 21)) / share) * inside
    spread = np.sqrt(np.maximum(cv2.blur(away * away, (41, 21)), 0) / share)
    even = np.asarray(np.clip(128 + 48 * away / (spread + _PLAIN), 0, 255), np.uint8)
    return even, np.asarray(spread > _PLAIN)


def _first_guess(pictures: Sequence[Lenses], circles: Sequence[Circle]) -> Pair:
    """Equidistant lenses, and the field of view and the turn at which the ring of both is most alike."""
    height, width = pictures[0][0].shape[:2]
    best = (-np.inf, 0.0, 0.0)
    for reach in _REACHES:
        pair = _equidistant(circles, reach, (width, height))
        directions = ring(_COARSE, min(_COARSE_HALF, reach - np.pi / 2))
        alike = np.zeros(_COARSE)
        for both in pictures:
            spectra = []
            for side in range(2):
                grey, there = show(pair, side, _grey(both[side]), directions)
                details = (_evened(grey, there)[0].astype(np.float64) - 128) * there
                details = np.asarray(cv2.GaussianBlur(details, (0, 0), 1.0), np.float64)
                spectra.append(np.fft.rfft(details / (np.linalg.norm(details) + 1e-9), axis=1))
            alike += np.fft.irfft((spectra[0] * spectra[1].conj()).sum(axis=0), _COARSE)
        if alike.max() > best[0]:
            best = (float(alike.max()), float(reach), alike.argmax() / _COARSE * 2 * np.pi)
    _, reach, turned = best
    return _equidistant(circles, reach, (width, height), turned)


def _equidistant(circles: Sequence[Circle], reach: float, size: tuple[int, int], turned: float = 0.0) -> Pair:
    """Lenses back to back, the second one's picture turned in radians."""
    one, other = (Lens(it.x, it.y, it.radius / reach) for it in circles)
    return Pair((one, replace(other, behind=True, turn=(0.0, 0.0, turned))), size, float(reach))


def _reach(lens: Lens, radius: float) -> float:
    """Radians from the axis at which a lens is `radius` pixels from its centre."""
    edge = lens.directions(np.array([[lens.x + radius, lens.y]])) @ lens.rotation.T
    return float(np.arctan2(np.hypot(edge[0, 0], edge[0, 1]), edge[0, 2]))


def _joined(points: Sequence[Points]) -> Points:
    return Points(np.concatenate([it.one for it in points]), np.concatenate([it.other for it in points]))


def _require_spread(points: Points, pair: Pair) -> None:
    """Raises OverlapError if there are too few points, or all on one side."""
    rays = pair.lenses[0].directions(points.one)
    sectors = (np.arctan2(rays[:, 1], rays[:, 0]) / (2 * np.pi) % 1 * _SECTORS).astype(int)
    seen = int((np.bincount(sectors, minlength=_SECTORS) >= 3).sum())
    if len(points.one) < _FEWEST or seen < _FEWEST_SECTORS:
        raise OverlapError(
            f"what both lenses show has too little texture: {len(points.one)} points in {seen} of {_SECTORS} "
            "parts of the ring around the camera; add pictures of places with more around"
        )


def _fitted(pair: Pair, points: Points, circles: Sequence[Circle]) -> Pair:
    """The lenses in which most points point in the same directions, near to what circles say."""
    one, other = pair.lenses
    sizes = np.array([it.radius for it in circles])
    ratio = np.log(sizes[0] / sizes[1])
    centres = np.array([(it.x, it.y) for it in circles])

    def lenses(values: Array) -> Pair:
        x, y, x2, y2, focal, focal2, edge, edge2, *turn = map(float, values)
        ours = replace(one, x=x, y=y, focal=focal, edge=edge)
        theirs = replace(other, x=x2, y=y2, focal=focal2, edge=edge2, turn=(turn[0], turn[1], turn[2]))
        return replace(pair, lenses=(ours, theirs))

    def off(values: Array) -> Array:
        apart = points.apart(lenses(values)) * values[4] / _NOISE
        # Robust by hand: the priors are not to be.
        square = (apart**2).sum(axis=1, keepdims=True)
        weight = np.sqrt(np.log1p(square) / np.maximum(square, 1e-12))
        priors = [
            *((values[:4] - centres.ravel()) / (_CENTRED * sizes.repeat(2))),
            (np.log(values[4] / values[5]) - ratio) / _ALIKE,
            (values[6] + values[7]) / 2 / _BENT,
            (values[6] - values[7]) / _BENT_ALIKE,
        ]
        return np.concatenate([(apart * weight).ravel(), np.array(priors) * 3])

    start = [one.x, one.y, other.x, other.y, one.focal, other.focal, one.edge, other.edge]
    scale = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 5e-4, 5e-4, 0.003, 0.003, 0.003]
    found = least_squares(off, np.array([*start, *other.turn]), x_scale=scale, ftol=1e-5, max_nfev=30).x
    return lenses(found)
