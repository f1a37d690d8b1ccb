"""An equirectangular camera."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Camera:
    """Pose, X_cam = rotation @ X + translation (x right, y down, z forward), and image size in pixels."""

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

    def to(self, device: torch.device | str) -> "Camera":
        """The same camera on another device."""
        return Camera(self.rotation.to(device), self.translation.to(device), self.width, self.height)
