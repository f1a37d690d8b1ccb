"""Points on surfaces that depth maps see and the sparse cloud has no points of, for the start of Stage I.

A map that is aligned by eq. 4 gives a point for each direction. One map alone is wrong along every edge, so
a point counts where the map of a camera near by has the same distance, and no more of these maps see past it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from torch import Tensor

from panolog.scene.images import View, pixels, unexposed
from panolog.scene.model import Panorama, Scene
from panolog.scene.projection import fibonacci_sphere, project_to_fractions

Floats = NDArray[np.float64]

RAYS = 20_000  # directions of a panorama, 1.4 degrees apart
WIDTH = 256  # of a map that is kept, pixels, at most
NEIGHBOURS = 6  # panoramas whose maps are compared
SAME = 0.02  # of a distance: how far two maps differ at most on one surface
PAST = 0.06  # from which part on a map sees past a point
FARTHEST = 5.0  # times as far from the centroid of cameras as the sparse cloud; the sky: 10 times (eq. 3)
_LEAST = 0.02  # radians that points are apart for the nearest camera, at least
_ROUNDS = 12  # of halving an angle, to a thousandth
_DIRECTIONS = fibonacci_sphere(RAYS)
_HASH = np.array([0x1E3779B97F4A7C15, 0x42B2AE3D27D4EB4F, 0x165667B19E3779F9], np.int64)  # odd, of no meaning


@dataclass(frozen=True, eq=False)
class Points:
    """Points with colours."""

    points: Floats  # (P, 3) world units
    colors: Floats  # (P, 3) RGB of 0 to 255

    def __len__(self) -> int:
        return len(self.points)


NO_POINTS = Points(np.empty((0, 3)), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class _Map:
    panorama: Panorama
    inverse_depth: NDArray[np.float32]  # (H, W) of 1 / world units, nan where no surface is known
    colors: NDArray[np.uint8]  # (RAYS, 3) of the directions, without the exposure

    def at(self, directions: Floats) -> Floats:
        """Inverse depths (N,) in directions (N, 3) of the camera; between pixels those of a plane."""
        height, width = self.inverse_depth.shape
        u, v = project_to_fractions(directions).T
        row = np.clip(v * height - 0.5, 0, height - 1)
        found: Floats = map_coordinates(self.inverse_depth, [row, u * width - 0.5], order=1, mode="grid-wrap")
        return found.astype(np.float64)

    def behind(self, points: Floats) -> Floats:
        """By which part of its distance each point (N, 3) is behind what the map shows; nan: unknown."""
        local = points @ self.panorama.rotation.T + self.panorama.translation
        found: Floats = np.log(np.linalg.norm(local, axis=1) * self.at(local))
        return found


class Surfaces:
    """What the depth maps of some panoramas agree on."""

    def __init__(self, scene: Scene) -> None:
        """None of the panoramas of a scene is taken into account yet."""
        self._scene = scene
        self._maps: list[_Map] = []

    def add(self, view: View, target: tuple[Tensor, Tensor] | None) -> None:
        """Takes one panorama into account, in two hundred kilobytes.

        Args: target, of `DepthTargets.target`; None where there is no usable map.
        """
        if target is None:
            return
        inverse, valid = (layer.cpu().numpy() for layer in target)
        known = np.where(valid & (inverse > 0), inverse, np.nan).astype(np.float32)
        height, width = known.shape
        v, u = (project_to_fractions(_DIRECTIONS)[:, ::-1] * (height, width)).astype(np.int64).T
        colors = (255 * unexposed(pixels(view.image, v, u) / 255.0, view.exposure)).round().astype(np.uint8)
        step = math.ceil(width / WIDTH)
        kept = known[step // 2 :: step, step // 2 :: step].copy()  # not a view of all of it
        self._maps.append(_Map(self._scene.panoramas[view.row], kept, colors))

    def points(self, sparse: Floats, centers: Floats, count: int) -> Points:
        """At most so many points, evenly over what the nearest cameras see, that fill the gaps of others.

        Args: sparse (P, 3), which need no second point in their place; centers (K, 3) of all cameras.
        """
        if count < 1 or not self._maps:
            return NO_POINTS
        middle = centers.mean(axis=0)
        reach = FARTHEST * float(np.linalg.norm(sparse - middle, axis=1).max())
        found, distance = self._agreed(cKDTree(centers), middle, reach)
        if not len(found):
            return NO_POINTS
        apart = cKDTree(sparse).query(found.points)[0] / distance

        def between(angle: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
            rows = (apart > angle).nonzero()[0]
            return rows, _cubes(found.points[rows], distance[rows], angle)

        least, most = _LEAST, math.pi
        for _ in range(_ROUNDS):
            angle = math.sqrt(least * most)
            fits = len(np.unique(between(angle)[1])) <= count
            least, most = (least, angle) if fits else (angle, most)
        rows, cubes = between(most)
        return _means(Points(found.points[rows], found.colors[rows]), cubes)

    def _agreed(self, nearest: cKDTree, middle: Floats, reach: float) -> tuple[Points, Floats]:
        """All points that maps agree on within a sphere, and their distances from the nearest camera."""
        own = np.array([one.panorama.center for one in self._maps])
        clouds, distances = [NO_POINTS], [np.empty(0)]
        for index, one in enumerate(self._maps):
            depth = 1 / one.at(_DIRECTIONS)
            known = np.isfinite(depth).nonzero()[0]
            points = own[index] + (_DIRECTIONS[known] * depth[known, None]) @ one.panorama.rotation
            distance, _ = nearest.query(points)
            same, past = np.zeros(len(points), int), np.zeros(len(points), int)
            for other in _others(own, index):
                behind = self._maps[other].behind(points)
                same += np.abs(behind) < SAME
                past += behind < -PAST
            sure = (same > 0) & (past <= same) & (distance > 0)
            sure &= np.linalg.norm(points - middle, axis=1) <= reach
            clouds.append(Points(points[sure], one.colors[known[sure]]))
            distances.append(distance[sure])
        joined = (np.concatenate([getattr(cloud, name) for cloud in clouds]) for name in ("points", "colors"))
        return Points(*joined), np.concatenate(distances)


def _others(centers: Floats, index: int) -> list[int]:
    """The nearest of some cameras to one of them."""
    apart = np.linalg.norm(centers - centers[index], axis=1)
    apart[index] = np.inf
    chosen: list[int] = np.argsort(apart, kind="stable")[: min(NEIGHBOURS, len(centers) - 1)].tolist()
    return chosen


def _cubes(points: Floats, distance: Floats, angle: float) -> NDArray[np.int64]:
    """A number for the cube of each point (N, 3): it spans an angle for the nearest camera, or half of it."""
    level = np.floor(np.log2(distance * angle))
    cubes = np.floor(points / np.exp2(level)[:, None]).astype(np.int64)
    numbers: NDArray[np.int64] = (cubes * _HASH).sum(axis=1) + level.astype(np.int64)
    return numbers


def _means(cloud: Points, cubes: NDArray[np.int64]) -> Points:
    """One point for each cube, the mean of those in it."""
    _, cube, number = np.unique(cubes, return_inverse=True, return_counts=True)

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(cube, column) for column in values.T], axis=1) / number[:, None]

    return Points(mean(cloud.points), mean(cloud.colors))
