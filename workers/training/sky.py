"""The sky sphere: distant Gaussians, so that near ones need not model the sky (eq. 3)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from panolog.scene.gaussians import Gaussians
from panolog.scene.images import View, pixels
from panolog.scene.model import Scene
from panolog.scene.projection import project_to_pixels
from panolog.workers.training.config import SkyConfig
from panolog.workers.training.initialise import isotropic


def sky_gaussians(
    scene: Scene, config: SkyConfig, count: int, views: Sequence[int], view: Callable[[int], View | None]
) -> Gaussians:
    """N_sky Gaussians on the sphere of radius κ · max‖x_i − C̄‖ about the training cameras' centroid (eq. 3).

    The maximum is over all sparse points, as the paper has it: a stray point makes the sky more distant, but
    changes neither its directions nor the angular size of its Gaussians.

    Args: count, N_sky; views, the rows of `scene.panoramas` to colour it from; view, which decodes a row,
    None = leave out.
    """
    centroid = scene.centers[list(scene.train)].mean(axis=0)
    radius = config.kappa * float(np.linalg.norm(scene.points - centroid, axis=1).max())
    means = centroid + radius * fibonacci_sphere(count)
    spacing = radius * math.sqrt(4 * math.pi / count)
    evenly = np.linspace(0, len(views) - 1, min(config.views, len(views))).astype(int)
    colors = _colors(scene, means, [views[i] for i in evenly], view)
    gaussians = isotropic(means, np.full(count, spacing), colors, config.opacity)
    return replace(gaussians, sky=count)


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """(count, 3) unit directions, evenly distributed: equal steps in height, the golden angle in azimuth.

    A uniform spherical sampling with neither holes nor clusters, unlike independent random directions.
    """
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    azimuth = index * (math.pi * (3 - math.sqrt(5)))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def _colors(
    scene: Scene, points: NDArray[np.float64], rows: Sequence[int], view: Callable[[int], View | None]
) -> NDArray[np.float64]:
    """(N, 3) mean colours in [0, 1] of the pixels that points (N, 3) fall on: the sky ones, else all."""
    sums = np.zeros((2, len(points), 3))  # of sky pixels, of all pixels
    counts = np.zeros((2, len(points), 1))
    for row, seen in zip(rows, map(view, rows), strict=True):
        if seen is None:
            continue
        height, width = seen.image.shape[:2]
        _, v, u = project_to_pixels(scene.panoramas[row], points, width, height)
        color = pixels(seen.image, v, u) / 255.0
        usable = np.ones(len(points), bool) if seen.mask is None else pixels(seen.mask, v, u)
        sky = usable if seen.sky is None else usable & pixels(seen.sky, v, u)
        for kind, chosen in enumerate((sky, usable)):
            sums[kind] += color * chosen[:, None]
            counts[kind] += chosen[:, None]
    means = sums / np.maximum(counts, 1)
    unseen = np.where(counts[1] > 0, means[1], 0.5)
    return np.where(counts[0] > 0, means[0], unseen)
