"""Similarities of the world: how an SfM result is moved, turned and scaled as a whole."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Similarity:
    """X_new = scale · rotation @ X + translation."""

    scale: float
    rotation: Array  # (3, 3)
    translation: Array  # (3,)

    def points(self, points: Array) -> Array:
        """(N, 3) points (N, 3) after the world has moved."""
        moved: Array = self.scale * points @ self.rotation.T + self.translation
        return moved

    def poses(self, rotations: Array, translations: Array) -> tuple[Array, Array]:
        """Rotations (K, 3, 3) and translations (K, 3), world-to-camera, after the world has moved.

        Pictures stay as they were: what a camera sees keeps its direction and gets `scale` times as far.
        """
        turned: Array = rotations @ self.rotation.T
        return turned, self.scale * translations - turned @ self.translation
