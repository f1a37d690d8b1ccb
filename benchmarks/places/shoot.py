"""Ray-casts the places of `layouts`: photographs in the order of the walk, or a video of them.

The light is that of an overcast day: no shadow distinguishes one side of a square from the other.
"""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.places.layouts import LAYOUTS, path
from panolog.scene.files import write_bytes
from panolog.scene.image_files import decode
from panolog.synthetic.layout import AHEAD, sun
from panolog.synthetic.light import shade
from panolog.synthetic.noise import Floats
from panolog.synthetic.trace import PanoramaRays, Scenery, Sun

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
POSES = "poses.json"
_SAMPLES = 2  # rays per pixel, each way
_GREY = 0.75  # display value of the sky of a bare place


class Overcast(Sun):
    """A sun behind clouds: it gives no direct light."""

    def __init__(self) -> None:
        super().__init__(sun(), [])

    def on(self, points: Floats, normals: Floats) -> Floats:  # noqa: ARG002
        """Share of the sun (N,) that reaches points (3, N): none."""
        return np.zeros(points.shape[1], np.float32)


@dataclass(frozen=True, eq=False)
class Walk:
    """Panoramas on disk and where they were taken."""

    images: tuple[Path, ...]
    centers: Array  # (K, 3) metres
    rotations: Array  # (K, 3, 3) world-to-camera


def shoot(place: str, folder: Path, *, bare: bool = False, width: int = 1024, seed: int = 0) -> Walk:
    """Writes FOLDER/images/NUMBER.jpg and FOLDER/poses.json; panoramas that are there are kept.

    Args: place, a name of `LAYOUTS`; bare, without texture on ground and sky; width, of the panoramas in
    pixels.
    Raises: KeyError, there is no such place; OSError, the folder cannot be written.
    """
    layout = LAYOUTS[place]
    centers, headings = path(layout, seed)
    random = np.random.default_rng([seed, 22])
    tilts = np.deg2rad(random.uniform(-1.5, 1.5, (len(headings), 2)))
    turns = Rotation.from_euler("ZYX", np.column_stack([headings, tilts]))
    rotations: Array = np.ascontiguousarray(AHEAD @ turns.inv().as_matrix())
    scenery = Scenery(layout.shapes(seed, bare))
    (folder / "images").mkdir(parents=True, exist_ok=True)
    images = tuple(folder / "images" / f"{row:03d}.jpg" for row in range(len(centers)))

    def one(row: int) -> None:
        if not images[row].is_file():
            picture = render(scenery, rotations[row], centers[row], width, bare)
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            write_bytes(images[row], data.tobytes())

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(one, range(len(images))))
    poses = {"centers": centers.tolist(), "rotations": rotations.tolist()}
    write_bytes(folder / POSES, json.dumps(poses).encode())
    return Walk(images, centers, rotations)


def render(scenery: Scenery, rotation: Array, center: Array, width: int, bare: bool) -> Image:
    """(width / 2, width, 3) BGR, of a camera with a world-to-camera rotation (3, 3) at `center` (3,)."""
    rays = PanoramaRays(rotation, center, width, _SAMPLES)
    hits = scenery.cast(rays)
    color = shade(scenery.shapes, rays, hits, Overcast())
    if bare:
        color[:, ~np.isfinite(hits.distance)] = _GREY
    parts = (width // 2, _SAMPLES, width, _SAMPLES)
    picture = np.clip(1.6 * color, 0, 1).reshape(3, *parts).mean(axis=(2, 4))
    return np.ascontiguousarray(np.rint(255 * picture).astype(np.uint8).transpose(1, 2, 0)[:, :, ::-1])


def as_video(walk: Walk, video: Path, fps: float = 2.0) -> Path:
    """Encodes the panoramas as the frames of a video in MPEG-4. Raises OSError if OpenCV cannot."""
    pictures = [decode(file, cv2.IMREAD_COLOR) for file in walk.images]
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(
        str(video), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), fps, (width, height)
    )
    if not writer.isOpened():
        raise OSError(f"{video}: OpenCV cannot write MPEG-4")
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return video
