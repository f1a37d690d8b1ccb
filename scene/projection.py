"""Where the pixel of a direction is in an equirectangular panorama."""

import numpy as np
from numpy.typing import NDArray


def project(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) u/W in [0, 1) and v/H of directions (N, 3) in camera axes: COLMAP's EQUIRECTANGULAR."""
    x, y, z = directions.T
    u = np.arctan2(x, z) / (2 * np.pi) + 0.5
    v = np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5
    return np.stack([u % 1.0, v], axis=1)
