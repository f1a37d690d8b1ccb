"""The map of all space into the unit cube, and back: linear inside the AABB, contracted outside.

The contraction is that of CityGaussian (Liu et al., ECCV 2024), which the paper cites: the AABB fills the
middle half of the cube, [1/4, 3/4) on every axis, and infinity lies on the cube's faces.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from panolog.partition.bounds import Aabb

_FARTHEST = 1e150  # beyond it the contraction is constant in float64, and quotients would overflow
_BELOW_ONE = np.nextafter(1.0, 0.0)


def contract(points: ArrayLike, aabb: Aabb) -> NDArray[np.float64]:
    """Contracted coordinates of world points.

    With n = 2(x − a_min)/(a_max − a_min) − 1 and m = ‖n‖∞: n ← (2 − 1/m)·n/m where m > 1; then y = n/4 + 1/2.

    Args: points (N, 3) in world units, of any finite size. Returns (N, 3) float64 in [0, 1).
    Raises ValueError if a coordinate is not finite or the shape is not (N, 3).
    """
    world = np.asarray(points, np.float64)
    if world.ndim != 2 or world.shape[1] != 3:
        raise ValueError(f"points need the shape (N, 3), not {world.shape}")
    if not np.isfinite(world).all():
        raise ValueError(
            f"{int((~np.isfinite(world).all(axis=1)).sum())} of {len(world)} points are not finite"
        )
    n = (world.clip(-_FARTHEST, _FARTHEST) - aabb.center) / aabb.half
    m = np.abs(n).max(axis=1, keepdims=True, initial=1.0)  # 1 inside, where the factor below is exactly 1
    n *= (2.0 - 1.0 / m) / m
    # far points round to a face or just beyond it
    return (n / 4.0 + 0.5).clip(0.0, _BELOW_ONE)


def expand(contracted: ArrayLike, aabb: Aabb) -> NDArray[np.float64]:
    """World points of contracted coordinates: the inverse of `contract`.

    Args: contracted (N, 3) inside the open unit cube. Returns (N, 3) float64 in world units.
    Raises ValueError for points on the faces of the cube, which lie at infinity, or outside of it.
    """
    y = np.asarray(contracted, np.float64)
    if y.ndim != 2 or y.shape[1] != 3:
        raise ValueError(f"contracted points need the shape (N, 3), not {y.shape}")
    if not ((y > 0.0) & (y < 1.0)).all():
        raise ValueError("only points inside the open unit cube have world coordinates")
    n = (y - 0.5) * 4.0
    m = np.abs(n).max(axis=1, keepdims=True, initial=1.0)
    n *= 1.0 / (m * (2.0 - m))  # from ‖contracted‖ = 2 − 1/m; exactly 1 inside
    return n * aabb.half + aabb.center
