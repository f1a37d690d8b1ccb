"""Cameras: the equirectangular one that is rendered, and pinhole views resampled from its panoramas."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene.model import Panorama

_MAX_PANORAMA_WIDTH = 16_384  # columns; OpenCV resamples images below 32,768
_MAX_SIZE = 32_766  # columns or rows that OpenCV resamples into
_BORDER = 2  # pixels around a panorama that bilinear sampling may touch


@dataclass(frozen=True, eq=False)
class Camera:
    """Pose, X_cam = rotation @ X + translation (x right, y down, z forward), and image size in pixels.

    >>> import torch, panolog
    >>> camera = panolog.Camera(torch.eye(3), torch.tensor([0.0, 0, 1]), width=512, height=256)
    """

    rotation: Tensor  # (3, 3) float32
    translation: Tensor  # (3,) float32
    width: int
    height: int

    @staticmethod
    def of(
        rotation: NDArray[np.float64], translation: NDArray[np.float64], width: int, height: int
    ) -> "Camera":
        """From (3, 3) and (3,) arrays, on the CPU."""
        return Camera(
            torch.from_numpy(np.asarray(rotation, np.float32)),
            torch.from_numpy(np.asarray(translation, np.float32)),
            width,
            height,
        )

    @staticmethod
    def at(panorama: Panorama, width: int) -> "Camera":
        """The camera of a panorama of a scene, at `width` pixels, on the CPU."""
        return Camera.of(panorama.rotation, panorama.translation, width, width // 2)

    def to(self, device: torch.device | str) -> "Camera":
        """This camera on another device."""
        return Camera(self.rotation.to(device), self.translation.to(device), self.width, self.height)


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with square pixels. Raises ValueError if the size or fov is out of range."""

    width: int  # pixels
    height: int  # pixels
    fov: float  # degrees, horizontal

    def __post_init__(self) -> None:
        if not 0 < self.fov < 180:
            raise ValueError(f"the field of view is {self.fov:g} degrees, must be above 0 and below 180")
        if min(self.width, self.height) < 1:
            raise ValueError(f"a picture of {self.width}x{self.height} pixels is empty")
        if max(self.width, self.height) > _MAX_SIZE:
            raise ValueError(f"a picture has at most {_MAX_SIZE} pixels each way")

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / math.tan(math.radians(self.fov) / 2)

    @property
    def panorama_width(self) -> int:
        """Columns of a panorama as fine as this lens at its left and right edge, where it is finest; even."""
        finest = self.focal / math.cos(math.radians(self.fov) / 2) ** 2  # pixels per radian
        return min(2 * math.ceil(math.pi * finest), _MAX_PANORAMA_WIDTH)


def facing(yaw: float, pitch: float) -> NDArray[np.float64]:
    """(3, 3) rotation from a lens to its panorama, turned `yaw` degrees to the right and `pitch` up."""
    y, p = math.radians(yaw), math.radians(pitch)
    turn = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    lift = np.array([[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]])
    direction: NDArray[np.float64] = turn @ lift
    return direction


def perspective(
    panorama: NDArray[np.uint8], lens: Lens, direction: NDArray[np.float64] | None = None
) -> NDArray[np.uint8]:
    """The image of a lens at the position of a panorama, resampled bilinearly across the seam and the poles.

    Args: panorama (H, 2H, 3); direction (3, 3), the lens's rotation into the panorama (`facing`), by default
    straight ahead. Returns (lens.height, lens.width, 3). It should have `lens.panorama_width` columns.
    """
    H, W = panorama.shape[:2]
    x = (np.arange(lens.width) + 0.5 - lens.width / 2) / lens.focal
    y = (np.arange(lens.height) + 0.5 - lens.height / 2) / lens.focal
    rays = np.stack([*np.meshgrid(x, y), np.ones((lens.height, lens.width))], axis=-1)
    if direction is not None:
        rays = rays @ direction.T
    u = W / (2 * np.pi) * np.arctan2(rays[..., 0], rays[..., 2]) + W / 2
    v = H / np.pi * np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2])) + H / 2
    shift = _BORDER - 0.5  # OpenCV has pixel centres at integers
    at_x, at_y = (u + shift).astype(np.float32), (v + shift).astype(np.float32)
    return np.asarray(cv2.remap(_with_border(panorama), at_x, at_y, cv2.INTER_LINEAR), np.uint8)


def _with_border(panorama: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The panorama with a border: half a turn away beyond the poles, wrapped at the seam."""
    opposite = np.roll(panorama, panorama.shape[1] // 2, axis=1)
    tall = np.concatenate([opposite[:_BORDER][::-1], panorama, opposite[-_BORDER:][::-1]])
    return np.pad(tall, ((0, 0), (_BORDER, _BORDER), (0, 0)), mode="wrap")
