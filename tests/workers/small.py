"""A scene small enough to train in a second: five cameras within a hollow sphere painted in soft colours."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.model import Panorama, Scene

RADIUS = 4.0  # of the sphere, world units
WIDTH, HEIGHT = 64, 32
SKY_ELEVATION = -0.9  # radians; higher up (y points down) is sky
AFFINE = (0.6, 0.05)  # inverse depth = 0.6 · prior + 0.05


def small_scene(folder: Path, *, layers: bool = True, points: int = 200) -> Scene:
    """A scene with images, and with `layers` masks, sky masks and depth images, on the disk in `folder`."""
    random = np.random.default_rng(5)
    directions = _normalized(random.normal(size=(points, 3)))
    panoramas = tuple(
        _panorama(folder, index, center, points, layers) for index, center in enumerate(_centers())
    )
    return Scene(
        root=folder,
        width=WIDTH,
        height=HEIGHT,
        panoramas=panoramas,
        points=RADIUS * directions,
        colors=(255 * _paint(directions)).astype(np.uint8),
        train=(0, 1, 2, 3),
        test=(4,),
        fingerprint="small",
    )


def _centers() -> NDArray[np.float64]:
    return np.array([[-0.3, 0, 0], [0.5, 0, 0], [0.5, 0.1, 0.5], [0, 0.1, 0.6], [0.2, 0, 0.3]], np.float64)


def _normalized(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def _paint(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) colours in [0, 1] of directions (..., 3) from the middle."""
    color: NDArray[np.float64] = 0.5 + 0.4 * np.sin(3 * directions + np.array([0.0, 1.0, 2.0]))
    return color


def rays_of(width: int) -> NDArray[np.float64]:
    """(H, W, 3) directions of the pixels of a panorama, in camera axes."""
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    elevation = ((np.arange(width // 2) + 0.5) / width * 2 * np.pi - np.pi / 2)[:, None]
    level = np.cos(elevation)
    parts = level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth, level * np.cos(azimuth)
    return np.stack(parts, axis=-1)


def distance_along(rays: NDArray[np.float64], center: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) distances of the sphere from a center within it along rays (..., 3) in the axes of the world."""
    along = rays @ center
    distance: NDArray[np.float64] = -along + np.sqrt(along**2 + RADIUS**2 - center @ center)
    return distance


def _panorama(folder: Path, index: int, center: NDArray[np.float64], points: int, layers: bool) -> Panorama:
    """One camera with the world's axes; its files are written."""
    rays = rays_of(WIDTH)
    distance = distance_along(rays, center)
    sky = np.arcsin(rays[..., 1]) < SKY_ELEVATION
    prior = np.where(sky, 0, (1 / distance - AFFINE[1]) / AFFINE[0])
    color = _paint((center + distance[..., None] * rays) / RADIUS)
    paths = {kind: folder / f"{kind}_{index}.png" for kind in ("image", "mask", "sky", "depth")}
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[-3:] = 0  # the operator
    cv2.imwrite(str(paths["image"]), (255 * color[..., ::-1]).astype(np.uint8))
    cv2.imwrite(str(paths["mask"]), mask)
    cv2.imwrite(str(paths["sky"]), np.where(sky, 0, 255).astype(np.uint8))
    cv2.imwrite(str(paths["depth"]), (65535 * prior).astype(np.uint16))
    return Panorama(
        name=f"pano_{index}.png",
        image=paths["image"],
        rotation=np.eye(3),
        translation=-center,
        observed=np.arange(points),
        mask=paths["mask"] if layers else None,
        sky_mask=paths["sky"] if layers else None,
        depth=paths["depth"] if layers else None,
    )
