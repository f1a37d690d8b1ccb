"""Perspective views of a panorama in twelve directions, for feature detection.

An equirectangular image is stretched near its poles, so that the same wall looks different from two places.
Features are detected in these views and written in pixels of the panorama: mapping needs no rig.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.projection import project_to_fractions

_COVER = 37.38  # degrees from the nearest direction at most: the circumradius of a dodecahedron's face
_MARGIN = 8.0  # degrees beyond, so that what lies at the border of two views is whole in both


def directions() -> NDArray[np.float64]:
    """(12, 3) unit vectors: the corners of an icosahedron that stands on one, up (-y) and down first."""
    ring = np.deg2rad(36.0 * np.arange(10))
    height = np.where(np.arange(10) % 2, 1.0, -1.0) / np.sqrt(5)
    rings = np.stack([2 / np.sqrt(5) * np.sin(ring), height, 2 / np.sqrt(5) * np.cos(ring)], axis=1)
    return np.concatenate([[[0, -1, 0], [0, 1, 0]], rings])


@dataclass(frozen=True)
class Faces:
    """The views of panoramas that are `width` pixels wide; their pixels are as large as the panorama's."""

    width: int

    @cached_property
    def size(self) -> int:
        """Pixels along each edge of a view."""
        return 2 * int(np.ceil(self.focal * np.tan(np.deg2rad(_COVER + _MARGIN))))

    @property
    def focal(self) -> float:
        """Pixels: what one radian is at the panorama's equator."""
        return self.width / (2 * np.pi)

    @cached_property
    def rotations(self) -> NDArray[np.float64]:
        """(12, 3, 3) camera from view: columns are the view's x, y and z axes in the panorama's camera."""
        found = []
        for forward in directions():
            down = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
            right = np.cross(down, forward)
            right /= np.linalg.norm(right)
            found.append(np.stack([right, np.cross(forward, right), forward], axis=1))
        return np.stack(found)

    def view(self, panorama: NDArray[np.uint8], face: int) -> NDArray[np.uint8]:
        """(size, size) the view `face` of a grey panorama (width / 2, width)."""
        u, v = self._lookup(face)
        return np.asarray(cv2.remap(panorama, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP), np.uint8)

    def to_panorama(
        self, pixels: NDArray[np.floating], face: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Where pixels (N, 2) of a view are in the panorama, with the centre of the first at (0.5, 0.5).

        Returns: (N, 2) pixels u in [0, width), v; (N,) whether no other view sees them nearer to its middle.
        """
        middle = self.size / 2
        rays = np.column_stack([(np.asarray(pixels, np.float64) - middle) / self.focal, np.ones(len(pixels))])
        rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ self.rotations[face].T
        own = np.argmax(rays @ self.rotations[:, :, 2].T, axis=1) == face
        return project_to_fractions(rays) * self._whole, own

    def _lookup(self, face: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(size, size) column and row of the panorama for each pixel, as cv2.remap counts them."""
        grid = (np.arange(self.size) + 0.5 - self.size / 2) / self.focal
        x, y = np.meshgrid(grid, grid)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ self.rotations[face].T
        pixels = (project_to_fractions(rays) * self._whole - 0.5).astype(np.float32).reshape(*x.shape, 2)
        return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])

    @property
    def _whole(self) -> tuple[int, int]:
        return self.width, self.width // 2
