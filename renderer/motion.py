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


class Common(NamedTuple):
    """The similarity by which cameras have moved together, about a middle: no error of single ones."""

    middle: Floats  # (3,)
    shift: Floats  # (3,)
    turn: Floats  # (3,) a rotation vector of the world
    growth: float  # relative

    @staticmethod
    def of(before: Floats, after: Floats, radius: float) -> "Common":
        """The similarity that explains the poses (V, 3, 4) after by those before best, by least squares.

        Args: radius, the length whose move is worth a turn by one radian. There is no growth where all
        centres are one.
        """
        places = centers(before)
        middle = places.mean(0)
        arms = (places - middle) / radius
        moves = (centers(after) - places) / radius
        turns = Rotation.from_matrix(after[:, :, :3].transpose(0, 2, 1) @ before[:, :, :3]).as_rotvec()
        system = np.zeros((len(before), 2, 3, 7))
        system[:, 0, :, :3] = np.eye(3) / radius
        system[:, 0, :, 3:6] = turning(arms)
        system[:, 0, :, 6] = arms
        system[:, 1, :, 3:6] = np.eye(3)
        values = np.stack([moves, turns], axis=1)
        found = np.linalg.lstsq(system.reshape(-1, 7), values.reshape(-1), rcond=1e-9)[0]
        return Common(middle, found[:3], found[3:6], float(found[6]))

    def undone(self, points: Floats) -> Floats:
        """(N, 3) points (N, 3) without it, to first order."""
        back = Rotation.from_rotvec(-self.turn).as_matrix()
        freed: Floats = self.middle + ((points - self.middle - self.shift) * (1 - self.growth)) @ back.T
        return freed

    def undone_poses(self, poses: Floats) -> Floats:
        """(V, 3, 4) poses (V, 3, 4) without it."""
        turned = poses[:, :, :3] @ Rotation.from_rotvec(self.turn).as_matrix()
        freed = self.undone(centers(poses))
        return np.concatenate([turned, -turned @ freed[:, :, None]], axis=2)


def turning(vectors: Floats) -> Floats:
    """(N, 3, 3) matrices that map a turn ω to ω × v, of vectors v (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)


def centers(poses: Floats) -> Floats:
    """(V, 3) the centres of cameras at poses (V, 3, 4)."""
    found: Floats = -np.einsum("vji,vj->vi", poses[:, :, :3], poses[:, :, 3])
    return found


def moved(rotation: Floats, translation: Floats, motion: Floats) -> tuple[Floats, Floats]:
    """The (3, 3) rotation and (3,) translation of a world-to-camera pose after a motion (6,)."""
    turn = Rotation.from_rotvec(motion[3:]).as_matrix()
    return turn @ rotation, turn @ translation + motion[:3]
