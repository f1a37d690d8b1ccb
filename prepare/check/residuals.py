"""How far the sparse points are from where each panorama has observed them."""

import numpy as np

from panolog.prepare.check.evidence import Array, Tracks, offsets
from panolog.scene.model import Scene

FEWEST = 20  # observations of a panorama whose median is taken


def measure_residuals(scene: Scene, tracks: Tracks) -> Array:
    """(K,) median distance of each panorama in pixels of the scene's width, along the sphere.

    NaN for a panorama with few observations.
    """
    found = np.full(len(scene.panoramas), np.nan)
    for row, panorama in enumerate(scene.panoramas):
        image = tracks.get(panorama.name)
        if image is None or len(image.points) < FEWEST:
            continue
        local = scene.points[image.points] @ panorama.rotation.T + panorama.translation
        apart = offsets(image.pixels / image.camera.width, local)
        found[row] = float(np.median(np.linalg.norm(apart, axis=1))) * scene.width
    return found


def describe(residuals: Array) -> str:
    """The measurement as one line."""
    known = residuals[np.isfinite(residuals)]
    middle, worst = float(np.median(known)), float(known.max())
    return f"poses: reprojections are off by {middle:.2f} px in the median panorama, {worst:.2f} px at worst"
