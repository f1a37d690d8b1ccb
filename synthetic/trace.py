"""Rays through a town: what the panoramas see, what the sun sees, and what a camera sees of given points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.noise import Floats
from panolog.synthetic.shapes import Shape, dot

Rows = NDArray[np.int64] | slice
Bools = NDArray[np.bool_]
_BATCH = 96  # shapes that are tried before hidden ones are looked for again
_FINE, _COARSE = 0.1, 0.5  # metres between the rays of a sun, near a camera and far from it
_TILE = 256  # rays along a side of a tile of shadows
_TILES = 5  # along a side of the square of tiles around a camera


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
        top, bottom, left, right = self.windows(center[None], np.array([radius]))[0].tolist()
        if bottom - top == self.lines and right - left == self.columns:
            return slice(None)
        rows, columns = np.arange(top, bottom), np.arange(left, right) % self.columns
        near: NDArray[np.int64] = (rows[:, None] * self.columns + columns).ravel()
        return near

    def windows(self, centers: Floats, radii: NDArray[np.float64]) -> NDArray[np.int64]:
        """(S, 4) of spheres at (S, 3): first row and the one after the last, the same of columns.

        The last column may be beyond the seam: it is less than `columns` after the first.
        """
        x, y, z = self._rotation @ (centers - self._center).T
        distance = np.sqrt(x * x + y * y + z * z)
        outside = distance > radii * 1.01
        distance, radii = np.where(outside, distance, 2.0), np.where(outside, radii, 1.0)
        spread = np.arcsin(radii / distance)
        elevation = np.arcsin(np.clip(y / distance, -1, 1))
        level = outside & (np.abs(elevation) + spread < np.pi / 2)  # neither pole is in the window
        half = np.arcsin(np.minimum(np.sin(spread) / np.where(level, np.cos(elevation), 1.0), 1.0))
        top, bottom = self._steps(elevation, spread, np.pi, self.lines)
        left, right = self._steps(np.arctan2(x, z), half, 2 * np.pi, self.columns)
        level &= right - left < self.columns
        top, bottom = (np.clip(row, 0, self.lines) for row in (top, bottom))
        left, right = np.where(level, left % self.columns, 0), np.where(level, right - left, self.columns)
        top, bottom = np.where(outside, top, 0), np.where(outside, bottom, self.lines)
        return np.stack([top, bottom, left, left + right], axis=1)

    @staticmethod
    def _steps(
        middle: NDArray[np.float64], half: NDArray[np.float64], span: float, count: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The first and the one after the last step of `span` within `half` of `middle`, and one each way."""
        first, last = ((middle + end) / span + 0.5 for end in (-half, half))
        return (
            np.floor(first * count).astype(np.int64) - 1,
            np.ceil(last * count).astype(np.int64) + 2,
        )


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


@dataclass(frozen=True, eq=False)
class SunSquare:
    """A square across the sun, in texels."""

    basis: Floats  # (3, 3) two directions across the sun, and that to it
    middle: tuple[float, float]  # metres along the first two
    reach: float  # half its side in metres
    texel: float  # metres

    @property
    def count(self) -> int:
        """Texels along a side."""
        return round(2 * self.reach / self.texel)


class SunRays:
    """Parallel rays from the sun, one per texel of a square."""

    def __init__(self, square: SunSquare, height: float):
        """Args: height, metres along the sun from the origin to where the rays begin."""
        self.square, self.height = square, np.float32(height)
        steps = (np.arange(square.count) + 0.5) * square.texel - square.reach
        rows, columns = ((steps + at).astype(np.float32) for at in square.middle)
        first, second, heights = np.meshgrid(columns, rows, [self.height], indexing="xy")
        plane = np.stack([second.ravel(), first.ravel(), heights.ravel()])
        self.origins: Floats = sum(plane[i] * square.basis[i][:, None] for i in range(3))
        self.directions: Floats = np.broadcast_to(-square.basis[2][:, None], self.origins.shape)

    def near(self, center: Floats, radius: float) -> Rows:
        """The texels in the square around the sphere."""
        if not np.isfinite(radius):
            return slice(None)
        square = self.square
        ranges = []
        for axis in (0, 1):
            middle = float(dot(square.basis[axis], center)) - square.middle[axis]
            first, last = ((middle + end + square.reach) / square.texel for end in (-radius, radius))
            ranges.append(np.arange(max(int(first), 0), min(int(last) + 1, square.count)))
        return (ranges[0][:, None] * square.count + ranges[1]).ravel()


def sun_basis(sun: Floats) -> Floats:
    """(3, 3): two directions across the sun, and that to it."""
    side = np.cross(sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(side, sun), sun]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Hits:
    """What each ray met first."""

    distance: Floats  # (N,) inf where it met nothing
    shape: NDArray[np.int32]  # (N,) index of the shape, -1 where it met nothing


def cast(shapes: Sequence[Shape], rays: Rays) -> Hits:
    """The first shape that each ray meets."""
    count = rays.directions.shape[1]
    distance = np.full(count, np.inf, np.float32)
    first = np.full(count, -1, np.int32)
    for index, shape in enumerate(shapes):
        rows = rays.near(shape.center, shape.radius)
        origins = rays.origins if rays.origins.shape[1] == 1 else rays.origins[:, rows]
        there = shape.enter(origins, rays.directions[:, rows])
        before = distance[rows]
        closer = there < before
        distance[rows] = np.where(closer, there, before)
        first[rows] = np.where(closer, np.int32(index), first[rows])
    return Hits(distance, first)


class Scenery:
    """The solids of a place, in spheres by which the few that matter for a camera are found among many."""

    def __init__(self, shapes: Sequence[Shape]):
        self.shapes = shapes
        self._centers = np.array([shape.center for shape in shapes], np.float64)  # (S, 3)
        self._radii = np.array([shape.radius for shape in shapes])

    def within(self, center: NDArray[np.float64], reach: float) -> list[Shape]:
        """The shapes with a part within `reach` metres of `center` (3,)."""
        away = np.linalg.norm(self._centers - center, axis=1) - self._radii
        return [self.shapes[index] for index in np.flatnonzero(away < reach * 1.001 + 1e-3).tolist()]

    def on_square(self, square: SunSquare) -> list[Shape]:
        """The shapes that rays through a square across the sun may meet."""
        off = np.abs(self._centers @ square.basis[:2].T - square.middle).max(axis=1) - self._radii
        return [self.shapes[index] for index in np.flatnonzero(off < square.reach * 1.001 + 1e-2).tolist()]

    def cast(self, rays: PanoramaRays, smallest: float = 0.0, among: NDArray[np.int64] | None = None) -> Hits:
        """Casts rays as `cast`, but in the order of distance, without shapes that nearer ones hide.

        Windows of the nearest distances in a pyramid tell what is hidden: the hierarchical z-buffer of
        Greene, Kass and Miller (SIGGRAPH 1993). Where two shapes are met at the same distance, the first is.

        Args: smallest, radians: shapes that look smaller are left out; among, of which shapes, None = of all.
        """
        away = np.linalg.norm(self._centers - rays.origins[:, 0], axis=1)
        # 0.1 % more than the radius, for rounding
        nearest = np.where(np.isinf(self._radii), -np.inf, away - 1.001 * self._radii - 1e-3)
        order = np.arange(len(away)) if among is None else among
        order = order[2 * self._radii[order] >= smallest * away[order]]
        order = order[np.argsort(nearest[order], kind="stable")]
        windows = rays.windows(self._centers[order], self._radii[order])
        picture = _Picture(rays)
        while order.size:
            for index, window in zip(order[:_BATCH].tolist(), windows[:_BATCH].tolist(), strict=True):
                picture.add(index, self.shapes[index], window, nearest[index])
            order, windows = order[_BATCH:], windows[_BATCH:]
            open_ = picture.farthest(windows) >= nearest[order]
            order, windows = order[open_], windows[open_]
        return Hits(picture.distance.ravel(), picture.first.ravel())


class _Picture:
    """What the rays of a panorama have met so far."""

    def __init__(self, rays: PanoramaRays):
        shape = (rays.lines, rays.columns)
        self._origin, self._directions = rays.origins, rays.directions.reshape(3, *shape)
        self.distance = np.full(shape, np.inf, np.float32)
        self.first = np.full(shape, -1, np.int32)

    def add(self, index: int, shape: Shape, window: Sequence[int], nearest: float) -> None:
        """Tries a shape, no nearer than `nearest`, on the rays of a window, which may cross the seam."""
        top, bottom, left, right = window
        columns = self.distance.shape[1]
        for part in (slice(left, min(right, columns)), slice(0, max(right - columns, 0))):
            before, first = self.distance[top:bottom, part], self.first[top:bottom, part]
            if not before.size or before.max() < nearest:
                continue
            directions = self._directions[:, top:bottom, part].reshape(3, -1)
            there = shape.enter(self._origin, directions).reshape(before.shape)
            closer = (there < before) | ((there == before) & (index < first))
            np.copyto(before, there, where=closer)
            np.copyto(first, np.int32(index), where=closer)

    def farthest(self, windows: NDArray[np.int64]) -> Floats:
        """At least the greatest of the distances (S,) in each of the windows (S, 4)."""
        top, bottom, left, right = windows.T
        size = np.maximum(bottom - top, right - left)
        levels = np.maximum(np.ceil(np.log2(size)).astype(np.int64), 1)  # of tiles no smaller than windows
        result = np.full(len(windows), np.inf, np.float32)
        tiles = self.distance
        for level in range(1, int(levels.max(initial=0)) + 1):
            tiles = _halved(tiles)
            here = np.flatnonzero(levels == level)
            first = left[here] >> level
            beyond_seam = ((right[here] - 1) % self.distance.shape[1]) >> level
            columns = (first, np.minimum(first + 1, tiles.shape[1] - 1), beyond_seam)
            rows = (top[here] >> level, (bottom[here] - 1) >> level)
            result[here] = np.max([tiles[row, column] for row in rows for column in columns], axis=0)
        return result


def _halved(tiles: Floats) -> Floats:
    """The greater values (ceil(H / 2), ceil(W / 2)) of 2 x 2 of (H, W)."""
    lines, columns = tiles.shape
    even = np.pad(tiles, ((0, lines % 2), (0, columns % 2)), mode="edge")
    rows = np.maximum(even[::2], even[1::2])
    return np.maximum(rows[:, ::2], rows[:, 1::2])


class ShadowMap:
    """How far along the sun's direction the first thing is that it meets, on a square across it."""

    def __init__(self, square: SunSquare, heights: Floats, lift: float):
        """Args: heights, (n, n) along the sun; lift, metres: a texel, or surfaces shade themselves."""
        self._square, self.heights, self._lift = square, heights, np.float32(lift)

    def on(self, points: Floats, normals: Floats) -> tuple[Floats, Bools]:
        """Share of the sun (N,) in [0, 1] that reaches points (3, N): of four texels; and which are in it."""
        square = self._square
        lifted = points + normals * self._lift
        x, y, height = (dot(axis, lifted) for axis in square.basis)
        row, column = (
            (c - middle + square.reach) / square.texel - np.float32(0.5)
            for c, middle in zip((x, y), square.middle, strict=True)
        )
        inside = (row > 0) & (column > 0) & (row < square.count - 2) & (column < square.count - 2)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        i, j = row.astype(np.int32), column.astype(np.int32)
        fi, fj = row - i, column - j
        lit = [
            (self.heights[i + a, j + b] <= height + 0.03).astype(np.float32) for a in (0, 1) for b in (0, 1)
        ]
        share = (lit[0] * (1 - fj) + lit[1] * fj) * (1 - fi) + (lit[2] * (1 - fj) + lit[3] * fj) * fi
        return np.where(inside, share, np.float32(1)), inside


class Sun:
    """The sun and the shadows that it casts: how much of it each point sees."""

    def __init__(self, direction: Floats, maps: Sequence[ShadowMap]):
        """Args: direction, (3,) to the sun; maps, each for where those before it do not reach."""
        self.direction, self._maps = direction, maps

    @classmethod
    def over(
        cls, shapes: Sequence[Shape], direction: Floats, reach: float = 62.0, texel: float = 0.1
    ) -> "Sun":
        """With one map around the origin."""
        square = SunSquare(sun_basis(direction), (0.0, 0.0), reach, texel)
        return cls(direction, [_shadow_map(shapes, square, 4 * reach, 0.1)])

    def around(self, _center: Floats) -> "Sun":
        """For a camera at `center` (3,): the same for all."""
        return self

    def on(self, points: Floats, normals: Floats) -> Floats:
        """Share of the sun (N,) in [0, 1] that reaches points (3, N). 1 out of the maps."""
        share, inside = self._maps[0].on(points, normals)
        for shadows in self._maps[1:]:
            rest = np.flatnonzero(~inside)
            share[rest], inside[rest] = shadows.on(points[:, rest], normals[:, rest])
        return share


class CitySun:
    """The sun over any number of solids: fine shadows around each camera, coarse ones beyond.

    The fine ones are made in tiles when a camera first needs them, and those made last are kept.
    """

    def __init__(self, scenery: Scenery, direction: Floats, center: NDArray[np.float64], reach: float):
        """Args: direction, (3,) to the sun; center, (3,) and reach, metres: where there are coarse ones."""
        self.direction, self._scenery = direction, scenery
        self._basis = sun_basis(direction)
        texel = max(_COARSE, reach / 2000)  # of a map that fits the memory
        middle = self._basis[:2] @ center
        self._coarse = self._map((float(middle[0]), float(middle[1])), reach, texel)
        self._tile = lru_cache(maxsize=16 * _TILES * _TILES)(self._fine_tile)

    def around(self, center: Floats) -> Sun:
        """For a camera at `center` (3,)."""
        first = [int(np.floor(axis @ center / (_FINE * _TILE))) - _TILES // 2 for axis in self._basis[:2]]
        heights = np.block(
            [[self._tile(first[0] + i, first[1] + j) for j in range(_TILES)] for i in range(_TILES)]
        )
        reach = _FINE * _TILE * _TILES / 2
        middle = (first[0] * _FINE * _TILE + reach, first[1] * _FINE * _TILE + reach)
        fine = ShadowMap(SunSquare(self._basis, middle, reach, _FINE), heights, _FINE)
        return Sun(self.direction, [fine, self._coarse])

    def _fine_tile(self, i: int, j: int) -> Floats:
        """(n, n) heights of a tile."""
        half = _FINE * _TILE / 2
        return self._map(((2 * i + 1) * half, (2 * j + 1) * half), half, _FINE).heights

    def _map(self, middle: tuple[float, float], reach: float, texel: float) -> ShadowMap:
        square = SunSquare(self._basis, middle, reach, texel)
        shapes = self._scenery.on_square(square)
        tops = [float(self._basis[2] @ it.center) + it.radius for it in shapes if np.isfinite(it.radius)]
        height = max(tops, default=0.0) + np.hypot(*middle) + 2 * reach
        return _shadow_map(shapes, square, height, texel)


def _shadow_map(shapes: Sequence[Shape], square: SunSquare, height: float, lift: float) -> ShadowMap:
    rays = SunRays(square, height)
    heights = rays.height - cast(shapes, rays).distance
    return ShadowMap(square, heights.reshape(square.count, square.count), lift)
