"""How far the sparse points are from where each panorama has observed them."""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from panolog.prepare.check.evidence import Array, offsets
from panolog.scene.colmap import ColmapImage, read_colmap
from panolog.scene.model import Scene
from panolog.scene.read import model_folder

FEWEST = 20  # observations of a panorama whose median is taken
Tracks: TypeAlias = Mapping[str, ColmapImage]


def read_tracks(scene: Scene) -> Tracks | None:
    """What each panorama has observed, by its name; None for a scene without observations.

    Raises SceneError if the model is damaged.
    """
    if not any(len(panorama.observed) for panorama in scene.panoramas):
        return None
    return {image.name: image for image in read_colmap(model_folder(scene.root)).images}


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
