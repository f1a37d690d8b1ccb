"""Rays through a town: what the panoramas see, what the sun sees, and what a camera sees of given points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.noise import Floats
from panolog.synthetic.shapes import Shape, dot

Rows = NDArray[np.int64] | slice
Near = tuple[int, float]  # the index of a shape, and a distance than which no part of it is nearer


class Rays(Protocol):
    """N rays, and which of them may meet a sphere."""

    origins: Floats  # (3, N), or (3, 1) where they share it
    directions: Floats  # (3, N) unit

    def near(self, center: Floats, radius: float) -> Rows:
        """At least the rays that meet the sphere: a small superset makes casting fast."""


class PanoramaRays:
    """Rays through the middle of each of `samples` x `samples` parts of each pixel of a panorama, row by row.

    `rotation` (3, 3) is world-to-camera, `center` (3,) the camera centre. Pixel (u, v) has azimuth
    2π(u/W - 1/2) and elevation π(v/H - 1/2), downwards positive: the inverse of COLMAP's EQUIRECTANGULAR.
    """

    def __init__(self, rotation: NDArray[np.float64], center: NDArray[np.float64], width: int, samples: int):
        self.columns, self.lines = width * samples, width * samples // 2
        self._rotation, self._center = rotation, center
        azimuth = ((np.arange(self.columns) + 0.5) / self.columns - 0.5) * 2 * np.pi
        elevation = ((np.arange(self.lines) + 0.5) / self.lines - 0.5) * np.pi
        across = np.stack([np.sin(azimuth), np.zeros(self.columns), np.cos(azimuth)])  # (3, columns)
        level, down = rotation.T @ across, rotation[1]  # in the world
        directions = (
            np.cos(elevation)[:, None] * level[:, None] + np.sin(elevation)[:, None] * down[:, None, None]
        )
        self.directions: Floats = directions.reshape(3, -1).astype(np.float32)
        self.origins: Floats = center[:, None].astype(np.float32)

    def near(self, center: Floats, radius: float) -> Rows:
        """The rays in the smallest window of rows and columns around the sphere; it may cross the seam."""
        x, y, z = self._rotation @ (center - self._center)
        distance = float(np.sqrt(x * x + y * y + z * z))
        if distance <= radius * 1.01:
            return slice(None)
        spread = np.arcsin(radius / distance)
        elevation = np.arcsin(y / distance)
        rows = self._steps(elevation, spread, np.pi, self.lines)
        rows = rows[(rows >= 0) & (rows < self.lines)]
        if abs(elevation) + spread >= np.pi / 2:
            columns = np.arange(self.columns)
        else:
            half = np.arcsin(min(np.sin(spread) / np.cos(elevation), 1.0))
            columns = (
                self._steps(np.arctan2(x, z), half, 2 * np.pi, self.columns)[: self.columns] % self.columns
            )
        return (rows[:, None] * self.columns + columns).ravel()

    @staticmethod
    def _steps(middle: float, half: float, span: float, count: int) -> NDArray[np.int64]:
        """Indices, maybe out of range, of the steps of `span` within `half` of `middle`, and one each way."""
        first, last = ((middle + end) / span + 0.5 for end in (-half, half))
        return np.arange(int(np.floor(first * count)) - 1, int(np.ceil(last * count)) + 2)


class PointRays:
    """Rays from `center` (3,) to each of `points` (N, 3)."""

    def __init__(self, points: NDArray[np.float64], center: NDArray[np.float64]):
        toward = points - center
        self.distances = np.linalg.norm(toward, axis=1)  # (N,)
        self.directions: Floats = (toward / self.distances[:, None]).T.astype(np.float32)
        self.origins: Floats = center[:, None].astype(np.float32)

    def near(self, center: Floats, radius: float) -> Rows:
        """The rays whose angle to the sphere's middle is small enough."""
        offset = center - self.origins[:, 0]
        distance = float(np.linalg.norm(offset))
        if distance <= radius * 1.01:
            return slice(None)
        cosine = np.sqrt(1 - (radius / distance) ** 2)
        return np.flatnonzero(dot(offset / distance, self.directions) >= cosine - 1e-4)


class SunRays:
    """Parallel rays from the sun, one per texel of a square across them, centred on the origin."""

    def __init__(self, sun: Floats, reach: float, texel: float):
        side = np.cross(sun, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        basis = np.stack([side, np.cross(side, sun), sun])  # (3, 3): across, across, to the sun
        self.basis = basis.astype(np.float32)
        self.count, self.reach, self.texel = round(2 * reach / texel), reach, texel
        self.height = np.float32(4 * reach)  # of the plane above the origin
        steps = ((np.arange(self.count) + 0.5) * texel - reach).astype(np.float32)
        first, second, height = np.meshgrid(steps, steps, [self.height], indexing="xy")
        plane = np.stack([second.ravel(), first.ravel(), height.ravel()])
        self.origins: Floats = sum(plane[i] * self.basis[i][:, None] for i in range(3))
        self.directions: Floats = np.broadcast_to(-self.basis[2][:, None], self.origins.shape)

    def near(self, center: Floats, radius: float) -> Rows:
        """The texels in the square around the sphere."""
        if not np.isfinite(radius):
            return slice(None)
        ranges = []
        for axis in (0, 1):
            middle = float(dot(self.basis[axis], center))
            first, last = ((middle + end + self.reach) / self.texel for end in (-radius, radius))
            ranges.append(np.arange(max(int(first), 0), min(int(last) + 1, self.count)))
        return (ranges[0][:, None] * self.count + ranges[1]).ravel()


@dataclass(frozen=True, eq=False)
class Hits:
    """What each ray met first."""

    distance: Floats  # (N,) inf where it met nothing
    shape: NDArray[np.int32]  # (N,) index of the shape, -1 where it met nothing


class Spheres:
    """Spheres around the shapes of a place, to find those that matter for one camera."""

    def __init__(self, shapes: Sequence[Shape]):
        self._centers = np.array([shape.center for shape in shapes])  # (S, 3)
        self._radii = np.array([shape.radius for shape in shapes])

    def seen(self, center: NDArray[np.float64], angle: float) -> list[Near]:
        """The shapes that look larger than `angle` (radians across) from `center` (3,), from near to far."""
        away = np.linalg.norm(self._centers - center, axis=1)
        nearest = np.where(np.isinf(self._radii), -np.inf, away - 1.001 * self._radii)  # rounding aside
        rows = np.flatnonzero(2 * self._radii > angle * away)
        rows = rows[np.argsort(nearest[rows], kind="stable")]
        return list(zip(rows.tolist(), nearest[rows].tolist(), strict=True))


def cast(shapes: Sequence[Shape], rays: Rays, order: Sequence[Near] | None = None) -> Hits:
    """The first shape that each ray meets.

    Args: order, those of the shapes that may be met, from near to far, so that hidden ones are soon left out;
    None = all of them.
    """
    count = rays.directions.shape[1]
    distance = np.full(count, np.inf, np.float32)
    first = np.full(count, -1, np.int32)
    for index, nearest in [(i, -np.inf) for i in range(len(shapes))] if order is None else order:
        shape = shapes[index]
        rows = rays.near(shape.center, shape.radius)
        before = distance[rows]
        if not before.size or before.max() <= nearest:
            continue
        origins = rays.origins if rays.origins.shape[1] == 1 else rays.origins[:, rows]
        there = shape.enter(origins, rays.directions[:, rows])
        closer = there < before
        distance[rows] = np.where(closer, there, before)
        first[rows] = np.where(closer, np.int32(index), first[rows])
    return Hits(distance, first)


class Sun:
    """The shadows of a town: how much of the sun each point sees. `direction` (3,) points to the sun."""

    def __init__(self, shapes: Sequence[Shape], direction: Floats, reach: float = 62.0, texel: float = 0.1):
        self.direction = direction
        self._rays = SunRays(direction, reach, texel)
        height = self._rays.height - cast(shapes, self._rays).distance
        # (n, n) along the sun, of what it meets first
        self._height = height.reshape(self._rays.count, self._rays.count)

    def on(self, points: Floats, normals: Floats) -> Floats:
        """Share of the sun (N,) in [0, 1] that reaches points (3, N): of four texels. 1 out of town."""
        rays = self._rays
        lifted = points + normals * np.float32(0.1)  # a texel's worth, or surfaces would shade themselves
        x, y, height = (dot(axis, lifted) for axis in rays.basis)
        row, column = ((c + rays.reach) / rays.texel - np.float32(0.5) for c in (x, y))
        inside = (row > 0) & (column > 0) & (row < rays.count - 2) & (column < rays.count - 2)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        i, j = row.astype(np.int32), column.astype(np.int32)
        fi, fj = row - i, column - j
        lit = [
            (self._height[i + a, j + b] <= height + 0.03).astype(np.float32) for a in (0, 1) for b in (0, 1)
        ]
        share = (lit[0] * (1 - fj) + lit[1] * fj) * (1 - fi) + (lit[2] * (1 - fj) + lit[3] * fj) * fi
        return np.where(inside, share, np.float32(1))
