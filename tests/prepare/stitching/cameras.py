"""A camera of two fisheye lenses that are known: double spheres, as of Usenko and others (3DV 2018)."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.stitching.calibrate import ring
from panolog.prepare.stitching.lenses import Pair

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
BEHIND = np.diag([-1.0, 1.0, -1.0])


@dataclass(frozen=True)
class DoubleSphere:
    """A lens: u = f x / (α d2 + (1 − α) (ξ d1 + z)) + c, with d1 = |x| and d2 = |x, y, ξ d1 + z|."""

    centre: tuple[float, float]  # pixels
    focal: float  # pixels
    xi: float
    alpha: float
    rotation: Array  # (3, 3) from body axes
    reach: float  # degrees from the axis
    gain: float = 1.0
    rim: float = 1.0  # values at `reach` over those at its middle: a cos⁴ of a power of the angle
    steep: float = 1.0  # that power

    def project(self, directions: Array) -> tuple[Array, Array]:
        """(..., 2) pixels, and (...) degrees from the axis."""
        x, y, z = np.moveaxis(directions @ self.rotation.T, -1, 0)
        moved = self.xi + z
        second = np.sqrt(x * x + y * y + moved * moved)
        scale = self.focal / (self.alpha * second + (1 - self.alpha) * moved)
        pixels = np.stack([x * scale + self.centre[0], y * scale + self.centre[1]], axis=-1)
        return pixels, np.rad2deg(np.arctan2(np.hypot(x, y), z))

    def picture(self, panorama: Image, size: int, noise: float, seed: int) -> Image:
        """(size, size, 3) what it shows of a panorama (H, 2 H, 3); its rays are found by looking them up."""
        height, width = panorama.shape[:2]
        angles = np.deg2rad(np.linspace(0, self.reach + 1, 20_000))
        flat = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1) @ self.rotation
        radii = np.hypot(*(self.project(flat)[0] - self.centre).T)
        y, x = np.mgrid[:size, :size] + 0.5
        away = np.stack([x - self.centre[0], y - self.centre[1]])
        radius = np.hypot(*away)
        angle = np.interp(radius, radii, angles)
        unit = away / np.maximum(radius, 1e-9)
        rays = np.stack([unit[0] * np.sin(angle), unit[1] * np.sin(angle), np.cos(angle)], axis=-1)
        rays = rays @ self.rotation
        u = (np.arctan2(rays[..., 0], rays[..., 2]) / (2 * np.pi) + 0.5) * width - 0.5
        v = (np.arcsin(np.clip(rays[..., 1], -1, 1)) / np.pi + 0.5) * height - 0.5
        maps = u.astype(np.float32), v.astype(np.float32)
        shown = cv2.remap(panorama, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP).astype(np.float64)
        edge = np.interp(np.deg2rad(self.reach), angles, radii)
        lit = np.clip(edge - radius + 0.5, 0, 1)[..., None]
        outer = (angle / np.deg2rad(self.reach)) ** self.steep
        falls = np.cos(outer * np.arccos(self.rim**0.25))[..., None] ** 4
        grain = np.random.default_rng(seed).normal(0, noise, shown.shape)
        return np.asarray(np.clip(shown * self.gain * falls * lit + grain + 2, 0, 255), np.uint8)


@dataclass(frozen=True, eq=False)
class Camera:
    """Two of them, in pictures of `size` pixels a side."""

    lenses: tuple[DoubleSphere, DoubleSphere]
    size: int

    def picture(self, panorama: Image, seed: int = 0, noise: float = 1.5) -> Image:
        """(size, 2 size, 3) both circles next to each other."""
        return np.hstack(
            [it.picture(panorama, self.size, noise, 2 * seed + n) for n, it in enumerate(self.lenses)]
        )


def camera(
    size: int = 512,
    *,
    turned: float = 0.0,
    tilt: float = 1.0,
    gain: float = 1.2,
    rim: float = 1.0,
    steep: float = 1.0,
) -> Camera:
    """Lenses that differ in centre, radius, projection and brightness; `tilt` and `turned` in degrees.

    Args: tilt, of the second lens against the first; turned, its picture about its axis; gain, of its light;
    rim, steep: of both.
    """
    tilted = Rotation.from_rotvec(np.deg2rad(tilt) * np.array([0.6, 0.64, 0.48])).as_matrix()
    about = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(turned)]).as_matrix()
    half = size / 2
    one = DoubleSphere(
        (half * 1.006, half * 0.992),
        half * 0.478,
        -0.20,
        0.59,
        np.eye(3),
        98.5,
        gain**-0.5,
        rim,
        steep,
    )
    other = DoubleSphere(
        (half * 0.989, half * 1.010),
        half * 0.475,
        -0.197,
        0.592,
        about @ tilted @ BEHIND,
        98.5,
        gain**0.5,
        rim,
        steep,
    )
    return Camera((one, other), size)


def errors(known: Camera, found: Pair, width: int) -> tuple[Array, Array]:
    """(2, N) how far both lenses are from the true ones in what both show, and (N,) from each other.

    Args: width, of the panorama in whose pixels that is.
    """
    directions = ring(720, np.deg2rad(8)).reshape(-1, 3)
    pixels, angles = zip(*(lens.project(directions) for lens in known.lenses), strict=True)
    both = (angles[0] < known.lenses[0].reach - 0.5) & (angles[1] < known.lenses[1].reach - 0.5)
    seen = [lens.directions(at[both]) for lens, at in zip(found.lenses, pixels, strict=True)]
    scale = width / 2 / np.pi
    off = np.stack([np.linalg.norm(it - directions[both], axis=1) for it in seen])
    return off * scale, np.linalg.norm(seen[0] - seen[1], axis=1) * scale


def write(path: Path, *lenses: Sequence[Image]) -> Path:
    """A video with a stream for each of `lenses`, H.264 and nearly without loss, a key frame every eighth."""
    height, width = lenses[0][0].shape[:2]
    with av.open(str(path), "w", format="mp4") as container:
        streams = []
        for _ in lenses:
            stream = container.add_stream("libx264", rate=30, options={"crf": "12", "g": "8"})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for number, pictures in enumerate(zip(*lenses, strict=True)):
            for stream, picture in zip(streams, pictures, strict=True):
                frame = av.VideoFrame.from_ndarray(picture, "bgr24")
                frame.pts, frame.time_base = number, Fraction(1, 30)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    return path
