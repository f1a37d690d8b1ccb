"""Where a panorama shows a direction or a point: equirectangular projection (app. B).

The two functions get the elevation from different formulas and so round differently; results that were
recorded with either depend on it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Panorama


def project_to_fractions(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) u/W in [0, 1) and v/H of directions (N, 3) in camera axes: COLMAP's EQUIRECTANGULAR."""
    x, y, z = directions.T
    u = np.arctan2(x, z) / (2 * np.pi) + 0.5
    v = np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5
    return np.stack([u % 1.0, v], axis=1)


def rays_of_fractions(fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) unit directions in camera axes of (N, 2) u/W and v/H: the inverse of `project_to_fractions`."""
    azimuth, elevation = (fractions - 0.5).T * np.array([[2 * np.pi], [np.pi]])
    level = np.cos(elevation)
    return np.stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)], axis=1)


def project_to_pixels(
    panorama: Panorama, points: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Distances, rows v and columns u (N,) at which a panorama shows points (N, 3) in world units."""
    local = points @ panorama.rotation.T + panorama.translation
    distance = np.linalg.norm(local, axis=1)
    azimuth = np.arctan2(local[:, 0], local[:, 2])
    elevation = np.arcsin(np.clip(local[:, 1] / np.maximum(distance, np.finfo(float).tiny), -1, 1))
    u = np.floor(width * (azimuth / (2 * math.pi) + 0.5)).astype(np.int64) % width
    v = np.floor(height * (elevation / math.pi + 0.5)).astype(np.int64).clip(0, height - 1)
    return distance, v, u


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """(count, 3) unit directions, evenly distributed: equal steps in height, the golden angle in azimuth.

    A uniform spherical sampling with neither holes nor clusters, unlike independent random directions.
    """
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    azimuth = index * (math.pi * (3 - math.sqrt(5)))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
