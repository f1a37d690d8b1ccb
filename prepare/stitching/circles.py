"""The circles that two fisheye lenses draw into a picture, found by the dark around them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Picture = NDArray[np.uint8]
Pixel = TypeVar("Pixel", np.uint8, np.uint16)

_RAYS = 720  # from the middle of a picture
_DARK = 24.0  # of 255: what is around a circle, with noise and stray light
_HALF = 0.5  # of the brightness within that a circle has at its edge
_WITHIN = (0.90, 0.97)  # of the radius, where that is measured
_NEAR = 0.06  # of the radius, where the edge is looked for once it is roughly known
_SMALLEST = 0.35  # of the shorter side of the picture that a radius is, at least
_SEEN = 0.2  # of the rays that meet an edge, at least
_INSIDE = 0.92  # of the radius that is within the picture on all sides: about 90 degrees from the axis
_ON_CIRCLE = 0.5  # of the edges that are near to the circle, at least


class CircleError(ValueError):
    """Why a picture is not one of two circles."""


@dataclass(frozen=True)
class Circle:
    """The circle of a lens in its picture, in pixels."""

    x: float
    y: float
    radius: float


def halves(picture: NDArray[Pixel]) -> tuple[NDArray[Pixel], NDArray[Pixel]]:
    """The pictures (H, W, ...) of both lenses in one of both: next to each other, or one above the other."""
    height, width = picture.shape[:2]
    across = width > height
    size = (width if across else height) // 2
    one, other = (picture[:, :size], picture[:, -size:]) if across else (picture[:size], picture[-size:])
    return np.ascontiguousarray(one), np.ascontiguousarray(other)


def find_circle(pictures: Sequence[Picture]) -> Circle:
    """The circle that a lens draws into all of its pictures (H, W, 3).

    Raises:
        CircleError: there is none, or too little of it.
    """
    brightest = pictures[0].max(axis=2)
    for picture in pictures[1:]:
        brightest = np.maximum(brightest, picture.max(axis=2))
    height, width = brightest.shape
    smooth = cv2.GaussianBlur(brightest, (0, 0), max(0.7, min(height, width) / 1500)).astype(np.float32)
    found = Circle(width / 2, height / 2, min(height, width) / 2)
    edges = _edges(smooth, found, None)
    if len(edges) < _SEEN * _RAYS:
        raise CircleError("no dark surrounding of a circle is in it")
    met = len(edges)
    found = _fitted(edges, found)
    for near in (_NEAR, _NEAR / 2):
        edges = _edges(smooth, found, near)
        if len(edges) < _ON_CIRCLE * met or found.radius < _SMALLEST * min(height, width):
            raise CircleError("what is bright in it is no circle")
        found = _fitted(edges, found)
    inside = min(found.x, found.y, width - found.x, height - found.y) / found.radius
    if inside < _INSIDE:
        raise CircleError(
            f"its circle is cut off: it ends after {max(inside, 0):.0%} of its radius on a side"
        )
    return found


def _edges(smooth: NDArray[np.float32], around: Circle, near: float | None) -> NDArray[np.float64]:
    """(N, 2) where rays from the middle of a circle leave what is bright, if that is within the picture.

    Args: smooth (H, W) grey levels; near, as a part of the radius, how far from the circle to look; None for
        the whole picture, at a fixed level.
    """
    height, width = smooth.shape
    most = float(np.hypot(height, width)) if near is None else (1 + near) * around.radius
    count = int(most * 2)
    radii = (np.arange(count) + 0.5) / count * most
    angles = (np.arange(_RAYS) + 0.5) / _RAYS * 2 * np.pi
    x = around.x + radii * np.cos(angles)[:, None]
    y = around.y + radii * np.sin(angles)[:, None]
    # The border is continued: what is bright there has no edge in the picture.
    maps = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    levels = cv2.remap(smooth, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (x > 1) & (x < width - 1) & (y > 1) & (y < height - 1)
    limit = np.full(_RAYS, _DARK)
    if near is not None:
        ring = (radii > _WITHIN[0] * around.radius) & (radii < _WITHIN[1] * around.radius)
        limit = np.maximum(np.median(levels[:, ring], axis=1) * _HALF, _DARK)
    bright = (levels > limit[:, None]) & inside
    last = count - 1 - bright[:, ::-1].argmax(axis=1)
    rays = np.arange(_RAYS)
    after = np.minimum(last + 1, count - 1)
    met = bright.any(axis=1) & (last < count - 1) & inside[rays, after]
    if near is not None:
        met &= (radii[last] > (1 - near) * around.radius) & (limit > 1.5 * _DARK)
    rays, last, after = rays[met], last[met], after[met]
    above, below = levels[rays, last] - limit[rays], levels[rays, after] - limit[rays]
    part = above / np.maximum(above - below, 1e-6)
    at = radii[last] + part * (radii[after] - radii[last])
    return np.column_stack([around.x + at * np.cos(angles[rays]), around.y + at * np.sin(angles[rays])])


def _fitted(edges: NDArray[np.float64], around: Circle) -> Circle:
    """The circle through most edges (N, 2)."""

    def off(circle: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.hypot(*(edges - circle[:2]).T) - circle[2])

    start = (around.x, around.y, float(np.median(np.hypot(*(edges - (around.x, around.y)).T))))
    scale = max(0.5, 0.002 * around.radius)
    found = least_squares(off, start, loss="cauchy", f_scale=scale).x
    return Circle(*map(float, found))
