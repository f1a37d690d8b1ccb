"""Tiny scenes on disk, a ring of panoramas with random pixels among random points; and copies of scenes."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.scene.colmap import Observations, write_colmap
from panolog.scene.model import Scene
from panolog.scene.write import require_new

WIDTH, HEIGHT = 64, 32
Change = Callable[[str, NDArray[np.uint8]], NDArray[np.uint8]]  # name and picture (H, W, 3) BGR


def write_scene(root: Path, *, names: Sequence[str] = (), points: int = 50, seed: int = 0) -> Path:
    """Writes a COLMAP scene with a panorama for each name (nine, if none is given) and returns `root`."""
    random = np.random.default_rng(seed)
    names = names or [f"pano_{i}.jpg" for i in range(9)]
    cloud = random.normal(size=(points, 3)) * 4
    images, observations = [], []
    for index, name in enumerate(names):
        rotation = Rotation.from_quat(random.normal(size=4)).as_matrix()
        angle = 2 * np.pi * index / len(names)
        center = np.array([np.cos(angle), np.sin(angle), 0.1 * index])
        images.append((name, rotation, -rotation @ center))
        observations.append(observe(cloud, rotation, center, random))
        write_image(root / "images" / name, random)
    write_colmap(
        root / "sparse" / "0",
        images,
        width=WIDTH,
        height=HEIGHT,
        points=cloud,
        colors=random.integers(0, 256, (points, 3), np.uint8),
        observations=observations,
    )
    return root


def observe(
    cloud: NDArray[np.float64],
    rotation: NDArray[np.float64],
    center: NDArray[np.float64],
    random: np.random.Generator,
) -> Observations:
    """Half of the points (P, 3), at random, where COLMAP's EQUIRECTANGULAR sees them."""
    rows = np.flatnonzero(random.random(len(cloud)) < 0.5)
    x, y, z = ((cloud[rows] - center) @ rotation.T).T
    u = WIDTH * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
    v = HEIGHT * (np.arcsin(y / np.sqrt(x * x + y * y + z * z)) / np.pi + 0.5)
    return rows, np.stack([u, v], axis=1)


def write_image(path: Path, random: np.random.Generator, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """A file of random pixels, in the format of its name, else PNG; `size` is (width, height)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix if cv2.haveImageWriter(path.name) else ".png"
    path.write_bytes(bytes(cv2.imencode(suffix, random.integers(0, 256, (size[1], size[0], 3), np.uint8))[1]))


def copy_scene(scene: Scene, output: Path, change: Change) -> None:
    """Writes the scene to a new folder, with all pictures changed and kept without loss.

    Raises OSError if the disk takes no file, InputError if `output` exists or a picture is not PNG.
    """
    require_new(output)
    images = next(name for name in ("images", "imgs") if (scene.root / name).is_dir())
    shutil.copytree(scene.root, output, ignore=shutil.ignore_patterns(images, "depth_truth.json"))
    for panorama in scene.panoramas:
        path = output / images / panorama.name
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = cv2.imread(str(panorama.image), cv2.IMREAD_COLOR)
        assert picture is not None
        if path.suffix.lower() == ".png":
            cv2.imwrite(str(path), change(panorama.name, np.asarray(picture, np.uint8)))
        else:
            quality = [cv2.IMWRITE_JPEG_QUALITY, 98]
            cv2.imwrite(str(path), change(panorama.name, np.asarray(picture, np.uint8)), quality)
