"""Three conformal views of a panorama, for feature detection: a band around the horizon, and the two poles.

An equirectangular image is stretched near its poles, so that the same wall looks different from two places.
The band is Mercator's projection up to 45 degrees from the horizon, the poles are stereographic: both keep
shapes, and change only sizes, by a factor of 1.4 at most, which features do not mind. Together they have no
more pixels than the panorama. Features are written in pixels of the panorama: mapping needs no rig.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.projection import project_to_fractions, rays_of_fractions

BAND, UP, DOWN = range(3)
_ROWS = 128
_BORDER = np.pi / 4  # radians from the horizon at which the band ends
_MARGIN = np.deg2rad(6.0)  # beyond, so that what lies at the border of two views is whole in both

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Faces:
    """The views of panoramas that are `width` pixels wide; where they are smallest, pixels are as large."""

    width: int

    @property
    def focal(self) -> float:
        """Pixels: what one radian is at the panorama's equator."""
        return self.width / (2 * np.pi)

    def size(self, face: int) -> tuple[int, int]:
        """(width, height) in pixels of a view."""
        if face == BAND:
            high = 2 * int(np.ceil(self.focal * np.arcsinh(np.tan(_BORDER + _MARGIN))))
            return self.width + 2 * self._beyond, high
        across = 2 * int(np.ceil(2 * self.focal * np.tan((np.pi / 2 - _BORDER + _MARGIN) / 2)))
        return across, across

    def tiles(self, face: int, most: int) -> list[tuple[slice, slice]]:
        """Columns of a view that are looked at together, about `most` pixels, and which of them count.

        What lies at the border of two tiles is whole in both.
        """
        across, high = self.size(face)
        edges = np.linspace(0, across, 1 + max(1, round(across * high / most))).astype(int).tolist()
        return [
            (slice(max(0, left - self._beyond), min(across, right + self._beyond)), slice(left, right))
            for left, right in pairwise(edges)
        ]

    def view(self, panorama: NDArray[np.uint8], face: int) -> NDArray[np.uint8]:
        """(height, width) the view `face` of a grey panorama (width / 2, width)."""
        u, v = _places(self, face)
        return np.asarray(cv2.remap(panorama, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP), np.uint8)

    def to_panorama(self, pixels: NDArray[np.floating], face: int) -> tuple[Array, NDArray[np.bool_]]:
        """Where pixels (N, 2) of a view are in the panorama, with the centre of the first at (0.5, 0.5).

        Returns: (N, 2) pixels u in [0, width), v; (N,) whether they are in the view's own part of the sphere.
        """
        places: Array = np.asarray(pixels, np.float64)
        fractions = project_to_fractions(self._rays(places, face))
        away = (fractions[:, 1] - 0.5) * np.pi  # from the horizon, down
        own = away >= _BORDER if face == DOWN else away < -_BORDER
        if face == BAND:
            column = places[:, 0] - self._beyond
            own = (away >= -_BORDER) & (away < _BORDER) & (column >= 0) & (column < self.width)
        return fractions * (self.width, self.width // 2), own

    @property
    def _beyond(self) -> int:
        """Columns of the band beyond each side of the seam."""
        return int(np.ceil(_MARGIN * self.focal))

    def _rays(self, pixels: Array, face: int) -> Array:
        """(N, 3) unit directions in camera axes of pixels (N, 2) of a view."""
        across, high = self.size(face)
        x, y = (pixels - (across / 2, high / 2)).T / self.focal
        if face == BAND:
            return rays_of_fractions(np.column_stack([x / (2 * np.pi), np.arctan(np.sinh(y)) / np.pi]) + 0.5)
        square = (x * x + y * y) / 4
        sign = 1.0 if face == DOWN else -1.0
        rays: Array = np.column_stack([x, sign * (1 - square), -sign * y]) / (1 + square)[:, None]
        return rays


@lru_cache(maxsize=3)
def _places(faces: Faces, face: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(height, width) columns and rows of the panorama, in OpenCV's pixels, that a view's pixels show.

    Once for the panoramas of one size: it takes a third as long as finding their features.
    """
    across, high = faces.size(face)
    u, v = np.empty((high, across), np.float32), np.empty((high, across), np.float32)
    for top in range(0, high, _ROWS):  # all at once take 150 bytes a pixel
        rows = slice(top, min(top + _ROWS, high))
        x, y = np.meshgrid(np.arange(across) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
        rays = faces._rays(np.column_stack([x.ravel(), y.ravel()]), face)
        where = project_to_fractions(rays) * (faces.width, faces.width // 2) - 0.5
        u[rows], v[rows] = (axis.reshape(x.shape) for axis in where.T)
    return u, v
