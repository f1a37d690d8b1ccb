"""The volume that the cameras triangulate well: baseline, margin and AABB (eqs. 7-9)."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from panolog.scene.errors import InputError

_LEAST = 1e-6  # of an axis over the longest one: contraction divides by it
_FEWEST = 8  # cameras among which spots and strays are looked for
_SPOT, _AT_SPOT = 5.0, 32  # baselines within which cameras may stand at one spot, and how many are looked at
_APART = 20.0  # baselines that spots are from each other, or they are none
_STRAY, _STRAYS = 20.0, 1 / 8  # times how far most cameras are from the middle; the largest share of cameras


@dataclass(frozen=True, eq=False)
class Aabb:
    """An axis-aligned box in world units, with a volume.

    Raises ValueError if a bound is not finite or the box has no extent along an axis.
    """

    lower: NDArray[np.float64]  # (3,)
    upper: NDArray[np.float64]  # (3,)

    def __post_init__(self) -> None:
        if self.lower.shape != (3,) or self.upper.shape != (3,):
            raise ValueError(f"an AABB needs bounds of shape (3,): {self.lower.shape}, {self.upper.shape}")
        if not (np.isfinite(self.lower).all() and np.isfinite(self.upper).all()):
            raise ValueError(f"an AABB needs finite bounds: {self.lower}, {self.upper}")
        if not (self.lower < self.upper).all():
            raise ValueError(f"an AABB needs lower < upper on every axis: {self.lower}, {self.upper}")

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) middle of the box."""
        return (self.lower + self.upper) / 2

    @property
    def half(self) -> NDArray[np.float64]:
        """(3,) half the extent along each axis."""
        return (self.upper - self.lower) / 2


def baseline(centers: ArrayLike) -> float:
    """Median distance of a camera to its nearest neighbour, b̂ (eq. 8).

    Where most cameras stand at one spot with a few others, as on a tripod that took several pictures, b̂ is
    that of the spots: eq. 8 would take the play of the tripod for the baseline.

    Args: centers (K, 3) camera centres in world units. World units; 0 if all cameras share a position.
    Raises InputError with fewer than two cameras, ValueError if a centre is not finite.
    """
    points = _checked(centers)
    if len(points) < 2:
        raise InputError("the scene has fewer than two cameras: distances between cameras need at least two")
    nearest = _nearest(points)
    spots = _spots(points, nearest)
    apart = nearest if spots is None else _nearest(spots)
    return apart if apart >= _APART * nearest else nearest


def strays(centers: ArrayLike) -> NDArray[np.bool_]:
    """(K,) which cameras are so far away from all others that their positions cannot be meant.

    Args: centers (K, 3). Raises ValueError if one is not finite.
    """
    points = _checked(centers)
    if len(points) < _FEWEST:
        return np.zeros(len(points), np.bool_)
    reach = np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.75)
    alone: NDArray[np.bool_] = scipy.spatial.cKDTree(points).query(points, k=2)[0][:, 1] > _STRAY * reach
    return alone if reach > 0 and alone.mean() <= _STRAYS else np.zeros_like(alone)


def _nearest(points: NDArray[np.float64]) -> float:
    nearest, _ = scipy.spatial.cKDTree(points).query(points, k=2)
    return float(np.median(nearest[:, 1]))  # the first is the camera itself, or another at its place


def _spots(points: NDArray[np.float64], nearest: float) -> NDArray[np.float64] | None:
    """(S, 3) a camera of each spot; None if cameras (K, 3), `nearest` apart, do not stand at spots."""
    count = len(points)
    if count < _FEWEST:
        return None
    distances, others = scipy.spatial.cKDTree(points).query(points, k=min(_AT_SPOT, count))
    row, column = np.nonzero(distances <= _SPOT * nearest)
    linked = scipy.sparse.coo_array((np.ones(len(row)), (row, others[row, column])), (count, count))
    spots, spot = scipy.sparse.csgraph.connected_components(linked, directed=False)
    _, first, sizes = np.unique(spot, return_index=True, return_counts=True)
    return points[first] if spots >= 3 and count <= 4 * spots and 2 * sizes.max() <= count else None


def margin(centers: ArrayLike, rho_tri: float) -> float:
    """The distance beyond the cameras up to which triangulation is reliable, b̂·ρ_tri (eq. 7), in world units.

    Args: centers (K, 3) in world units. Raises as `baseline`.
    """
    return baseline(centers) * rho_tri


def aabb(centers: ArrayLike, rho_tri: float, aspect: float = 0.0) -> Aabb:
    """The effective reconstruction volume: the trajectory about its centroid, widened by the margin (eq. 9).

    Above a thin box the contraction's maximum norm follows the thin axis alone and draws everything towards
    the middle: of a house at the rim of a level walk, the upper storeys are in another cell than the others.
    With an aspect of a half, which eq. 9 does not have, a line along any axis through the box stays in one
    column of cells at least as far as a quarter of the longest axis on both sides of the centroid.

    Args: centers (K, 3) training camera centres in world units; aspect, how long each axis of the box is at
    least, over the longest one. `strays` are left out. Raises InputError with fewer than two cameras or if
    all are at one position, ValueError if a centre is not finite.
    """
    points = _checked(centers)
    points = points[~strays(points)]
    centroid = points.mean(axis=0)
    half = np.abs(points - centroid).max(axis=0, initial=0.0) + margin(points, rho_tri)
    largest = half.max()
    if not largest > np.finfo(np.float64).eps * np.abs(points).max():
        raise InputError(
            "all cameras of the scene are at one position: without a baseline it cannot be split"
        )
    half = np.maximum(half, max(aspect, _LEAST) * largest)
    return Aabb(centroid - half, centroid + half)


def _checked(centers: ArrayLike) -> NDArray[np.float64]:
    points = np.asarray(centers, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"camera centres need the shape (K, 3), not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(
            f"camera {int(np.argmin(np.isfinite(points).all(axis=1)))} has a centre that is not finite"
        )
    return points
