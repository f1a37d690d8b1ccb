"""Which pixels of a panorama show given points."""

import math

import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Panorama


def pixels(
    panorama: Panorama, points: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Where points (N, 3) fall in a panorama (app. B): distances (N,), rows v (N,) and columns u (N,)."""
    local = points @ panorama.rotation.T + panorama.translation
    distance = np.linalg.norm(local, axis=1)
    azimuth = np.arctan2(local[:, 0], local[:, 2])
    elevation = np.arcsin(np.clip(local[:, 1] / np.maximum(distance, np.finfo(float).tiny), -1, 1))
    u = np.floor(width * (azimuth / (2 * math.pi) + 0.5)).astype(np.int64) % width
    v = np.floor(height * (elevation / math.pi + 0.5)).astype(np.int64).clip(0, height - 1)
    return distance, v, u
