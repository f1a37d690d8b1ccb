"""A sparse cloud as structure-from-motion would find it, but without its outliers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.noise import Floats
from panolog.synthetic.trace import Hits, PanoramaRays, PointRays, Scenery, cast

FAR = 120.0  # metres; what is farther moves too little between panoramas to be triangulated


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Points on surfaces."""

    points: NDArray[np.float64]  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB
    distance: NDArray[np.float64]  # (P,) from the panorama that sampled the point


def sample_surfaces(
    rays: PanoramaRays,
    hits: Hits,
    color: Floats,
    count: int,
    random: np.random.Generator,
    far: float = FAR,
) -> SurfaceSample:
    """About `count` points that a panorama sees, fewer of the ground nearby; `color` (3, N) is of its rays.

    Directions are uniform on the sphere: equal areas of a panorama's cylinder are equal solid angles.
    """
    tries = 8 * count
    row = (np.arcsin(random.uniform(-1, 1, tries)) / np.pi + 0.5) * rays.lines
    column = random.uniform(0, rays.columns, tries)
    index = np.minimum(row.astype(np.int64), rays.lines - 1) * rays.columns + column.astype(np.int64)
    distance = hits.distance[index]
    index = index[(distance < far) & (random.uniform(0, 6, tries) < distance)][:count]
    distance = hits.distance[index]
    points = rays.origins + distance * rays.directions[:, index]
    return SurfaceSample(
        points.T.astype(np.float64),
        np.rint(255 * color[:, index].T).astype(np.uint8),
        distance.astype(np.float64),
    )


def concatenate_samples(parts: Sequence[SurfaceSample]) -> SurfaceSample:
    """The samples of all parts, in order."""
    return SurfaceSample(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.colors for part in parts]),
        np.concatenate([part.distance for part in parts]),
    )


def visible_rows(
    scenery: Scenery, points: NDArray[np.float64], center: NDArray[np.float64], far: float = FAR
) -> NDArray[np.int64]:
    """Rows of the points (P, 3), ascending, that nothing hides from `center` (3,), found by a ray to each.

    Args: far, metres from which on points are not seen.
    """
    near = np.flatnonzero(np.linalg.norm(points - center, axis=1) < far)
    rays = PointRays(points[near], center)
    hits = cast(scenery.within(center, far), rays)
    reach = rays.distances
    seen: NDArray[np.int64] = near[hits.distance > reach - 0.02 - 0.003 * reach]
    return seen
