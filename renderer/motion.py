"""Motions of cameras: how the loss changes as one moves, as the kernels sum it, and moved poses.

A motion is (τ, ω): x y z of a translation in world units and of a turn in radians, both in the camera's axes,
X_cam = exp(ω)·(R·X + t) + τ.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

MOTION = 6  # values of a motion
MOTION_SUMS = 27  # kMotionSums in csrc/gradients.h: a gradient, and half of a symmetric matrix

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """What one rendering says of its camera's motion."""

    gradient: Floats  # (6,) dL/d(τ, ω)
    moments: Floats  # (6, 6) Σ m·mᵀ of the parts m that single Gaussians have in the gradient

    @staticmethod
    def of(sums: NDArray[np.float64]) -> "Motion":
        """From the (27,) sums of the kernels."""
        moments = np.zeros((MOTION, MOTION))
        moments[np.triu_indices(MOTION)] = sums[MOTION:]
        return Motion(sums[:MOTION].copy(), moments + np.triu(moments, 1).T)


def moved(rotation: Floats, translation: Floats, motion: Floats) -> tuple[Floats, Floats]:
    """The (3, 3) rotation and (3,) translation of a world-to-camera pose after a motion (6,)."""
    turn = Rotation.from_rotvec(motion[3:]).as_matrix()
    return turn @ rotation, turn @ translation + motion[:3]
