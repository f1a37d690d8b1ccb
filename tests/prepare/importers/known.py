"""A small scene of which everything is known, to be written in every format."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.scenes import HEIGHT, WIDTH, observe, write_image

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Known:
    """Camera x right, y down, z forward; world-to-camera; pixel centres at +0.5."""

    names: tuple[str, ...]  # sorted
    rotations: Array  # (K, 3, 3)
    centers: Array  # (K, 3)
    points: Array  # (P, 3)
    colors: NDArray[np.uint8]  # (P, 3) RGB
    observed: tuple[NDArray[np.int64], ...]  # K of (M,) rows of the points
    pixels: tuple[Array, ...]  # K of (M, 2)
    width: int = WIDTH
    height: int = HEIGHT

    @property
    def translations(self) -> Array:
        """(K, 3)."""
        translations: Array = -np.einsum("kij,kj->ki", self.rotations, self.centers)
        return translations

    def camera_to_world(self, index: int, axes: Array) -> Array:
        """(4, 4) pose of a camera whose axes are ours times `axes` (3, 3)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotations[index].T @ axes
        matrix[:3, 3] = self.centers[index]
        return matrix


def make_known(folder: Path, *, images: str = "images", seed: int = 7) -> Known:
    """Six panoramas, near upright, among forty points; writes the images into folder/images."""
    random = np.random.default_rng(seed)
    names = tuple(f"pano_{index:02d}.png" for index in range(6))
    rotations = Rotation.from_euler(
        "ZXY", np.column_stack([random.normal(0, 0.1, (6, 2)), random.uniform(-3, 3, 6)])
    ).as_matrix()
    centers = np.column_stack([np.arange(6.0), random.normal(0, 0.2, 6), random.normal(0, 1, 6)])
    points = random.normal((2.5, 0, 0), 4, (40, 3))
    colors = random.integers(0, 256, (40, 3), np.uint8)
    observed, pixels = zip(
        *(observe(points, *pose, random) for pose in zip(rotations, centers, strict=True)), strict=True
    )
    for name in names:
        write_image(folder / images / name, random)
    return Known(names, rotations, centers, points, colors, observed, pixels)
