"""Writes the town as a COLMAP scene: panoramas, sky masks, depth maps and a sparse model."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import write_colmap
from panolog.scene.errors import ConfigError
from panolog.scene.files import write_bytes
from panolog.scene.write import Progress, no_progress
from panolog.synthetic.layout import camera_path, sun, town
from panolog.synthetic.light import shade
from panolog.synthetic.noise import Floats
from panolog.synthetic.shapes import Shape
from panolog.synthetic.sparse import SurfaceSample, concatenate_samples, sample_surfaces, visible_rows
from panolog.synthetic.trace import PanoramaRays, Sun, cast

SAMPLES = 3  # rays per pixel, each way


@dataclass(frozen=True, eq=False)
class TownScene:
    """The town and its cameras: what all panoramas share."""

    folder: Path
    shapes: Sequence[Shape]
    sun: Sun
    rotations: NDArray[np.float64]  # (K, 3, 3) world-to-camera
    centers: NDArray[np.float64]  # (K, 3) metres
    width: int
    samples: int  # points that each panorama samples for the sparse cloud
    seed: int


def make_town(
    folder: Path,
    *,
    panoramas: int = 28,
    width: int = 512,
    points: int = 8000,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Path:
    """Ray-casts a small town and writes it as a COLMAP scene; returns `folder`.

    The scene has `images/*.png`, `sparse/0/*.bin` (exact poses, metres, z up; tracks without outliers),
    `skymasks/*.png` (255 foreground, 0 sky) and `depths/*.png` (half as wide; 16 bit, radial inverse depth
    through an affine that differs from image to image, 0 in the sky). Equal arguments write equal bytes.

    Args:
        folder: made if missing.
        panoramas: how many, at least 2.
        width: of the panoramas in pixels, a multiple of 4; they are half as high.
        points: of the sparse cloud; fewer where too few are seen twice.
        seed: of the houses, the path and the cloud.
        progress: called first with 0, then after each panorama, in order: how many are done, and of how many.
            Each counts twice: its picture, and what it sees of the sparse cloud.

    Raises:
        ConfigError: too few panoramas, or a width that cannot be.
        OSError: `folder` cannot be written.
    """
    if panoramas < 2:
        raise ConfigError(f"a town of {panoramas} panoramas cannot be reconstructed: give 2 or more")
    if width < 32 or width % 4:
        raise ConfigError(f"a width of {width} is not possible: give a multiple of 4, at least 32")
    for part in ("images", "depths", "skymasks"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    rotations, centers = camera_path(panoramas, seed)
    shapes = town(seed)
    scene = TownScene(
        folder, shapes, Sun(shapes, sun()), rotations, centers, width, 2 * points // panoramas + 1, seed
    )
    samples: list[SurfaceSample] = []
    rows: list[NDArray[np.int64]] = []
    progress(0, 2 * panoramas)
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for done, sample in enumerate(pool.map(partial(_panorama, scene), range(panoramas)), start=1):
            samples.append(sample)
            progress(done, 2 * panoramas)
        cloud = concatenate_samples(samples)
        for seen in pool.map(partial(visible_rows, shapes, cloud.points), centers):
            rows.append(seen)
            progress(panoramas + len(rows), 2 * panoramas)
    _write_model(scene, cloud, rows, points)
    return folder


def _panorama(scene: TownScene, index: int) -> SurfaceSample:
    """Renders and writes one panorama with its sky mask and depth map; samples points for the cloud."""
    rays = PanoramaRays(scene.rotations[index], scene.centers[index], scene.width, SAMPLES)
    hits = cast(scene.shapes, rays)
    color = shade(scene.shapes, rays, hits, scene.sun)
    parts = (scene.width // 2, SAMPLES, scene.width, SAMPLES)
    # Averaged as displayed, not as light: that is how splatting blends, and so what a model can reach.
    image = np.rint(255 * color.reshape(3, *parts).mean(axis=(2, 4))).astype(np.uint8).transpose(1, 2, 0)
    scenery = np.isfinite(hits.distance).reshape(parts).mean(axis=(1, 3)) >= 0.5
    _write_png(scene.folder / "images" / _name(index), image[:, :, ::-1])
    _write_png(scene.folder / "skymasks" / _name(index), np.where(scenery, 255, 0).astype(np.uint8))
    _write_png(scene.folder / "depths" / _name(index), _depth_map(scene, index))
    return sample_surfaces(rays, hits, color, scene.samples, np.random.default_rng([scene.seed, 3, index]))


def _depth_map(scene: TownScene, index: int) -> NDArray[np.uint16]:
    """(H/2, W/2) inverse radial depth as a monocular estimator gives it: of unknown scale and offset."""
    rays = PanoramaRays(scene.rotations[index], scene.centers[index], scene.width // 2, 1)
    inverse = 1 / cast(scene.shapes, rays).distance.reshape(rays.lines, rays.columns)
    random = np.random.default_rng([scene.seed, 4, index])
    scale, offset = random.uniform(0.55, 0.9) / inverse.max(), random.uniform(0.02, 0.09)
    return np.where(inverse > 0, np.rint(65535 * (scale * inverse + offset)), 0).astype(np.uint16)


def _write_model(scene: TownScene, cloud: SurfaceSample, rows: list[NDArray[np.int64]], points: int) -> None:
    """Keeps `points` of the cloud that two panoramas see, adds a small error, and writes sparse/0."""
    views = np.bincount(np.concatenate(rows), minlength=len(cloud.points))
    random = np.random.default_rng([scene.seed, 5])
    kept = np.sort(random.permutation(np.flatnonzero(views >= 2))[:points])
    row_of = np.full(len(cloud.points), -1)
    row_of[kept] = np.arange(len(kept))
    where, distance = cloud.points[kept], cloud.distance[kept, None]
    noisy = where + random.standard_normal(where.shape) * (0.004 + 0.001 * distance)
    images, observations = [], []
    for index, (rotation, center) in enumerate(zip(scene.rotations, scene.centers, strict=True)):
        images.append((_name(index), rotation, -rotation @ center))
        seen = row_of[rows[index]]
        seen = seen[seen >= 0]
        observations.append((seen, project((where[seen] - center) @ rotation.T, scene.width)))
    write_colmap(
        scene.folder / "sparse" / "0",
        images,
        width=scene.width,
        height=scene.width // 2,
        points=noisy,
        colors=cloud.colors[kept],
        observations=observations,
    )


def project(points: Floats, width: int) -> NDArray[np.float64]:
    """Pixels (N, 2), u in [0, W), of camera-space points (N, 3): COLMAP's EQUIRECTANGULAR.

    Not `scene.projection`: its formulas round differently, which would change the bytes of the town.
    """
    x, y, z = points.T
    u = width / (2 * np.pi) * np.arctan2(x, z) + width / 2
    v = width / (2 * np.pi) * np.arcsin(y / np.linalg.norm(points, axis=1)) + width / 4
    return np.stack([u % width, v], axis=1)


def _name(index: int) -> str:
    return f"street_{index:03d}.png"


def _write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Writes an image, channels in cv2's order, atomically."""
    _, encoded = cv2.imencode(".png", image)
    write_bytes(path, encoded.tobytes())
