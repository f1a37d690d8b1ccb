"""The frame of exported files: y up, as viewers expect it, with an origin near the cameras."""

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from panolog.scene.projection import fibonacci_sphere

Doubles = NDArray[np.float64]

Y_DOWN = (0.0, -1.0, 0.0)  # up in a world with COLMAP's axes, which a model without a scene is taken to have
_SAMPLES = 64  # directions from which rotations of spherical harmonics are found; 16 would do


@dataclass(frozen=True, eq=False)
class Frame:
    """exported = rotation · (world − origin)."""

    rotation: Doubles = field(default_factory=lambda: np.eye(3))  # (3, 3)
    origin: Doubles = field(default_factory=lambda: np.zeros(3))  # (3,) world units

    @staticmethod
    def upright(up: tuple[float, float, float], origin: Doubles | None = None) -> "Frame":
        """Turns `up` (a direction of the world) to +y, by the smallest angle; if it is −y, around x.

        Raises ValueError if `up` has no length.
        """
        length = float(np.linalg.norm(up))
        if not length > 0 or not np.isfinite(length):
            raise ValueError(f"{up} is no direction")
        y, wanted = np.asarray(up) / length, np.array([0.0, 1.0, 0.0])
        axis, cosine = np.cross(y, wanted), float(y @ wanted)
        sine = float(np.linalg.norm(axis))
        vector = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
        rotation = scipy.spatial.transform.Rotation.from_rotvec(vector * np.arctan2(sine, cosine)).as_matrix()
        exact = np.round(rotation) + 0.0  # without negative zeros
        rotation = exact if np.abs(rotation - exact).max() < 1e-9 else rotation
        return Frame(rotation, np.zeros(3) if origin is None else np.asarray(origin, np.float64))

    def points(self, points: NDArray[np.floating]) -> Doubles:
        """(..., 3) points (..., 3) of the world in this frame."""
        return np.asarray((points - self.origin) @ self.rotation.T)

    @property
    def inverse(self) -> "Frame":
        """From this frame to the world."""
        return Frame(self.rotation.T, -self.rotation @ self.origin)

    def turn(
        self, means: NDArray[np.float32], quats: NDArray[np.float32], rest: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Means (N, 3), unit quaternions (N, 4) w x y z and SH beyond degree 0 (N, K, 3) in this frame."""
        moved = self.points(means.astype(np.float64)).astype(np.float32)
        if np.array_equal(self.rotation, np.eye(3)):
            return moved, quats, rest
        turned = (
            scipy.spatial.transform.Rotation.from_matrix(self.rotation)
            * scipy.spatial.transform.Rotation.from_quat(quats, scalar_first=True)
        ).as_quat(canonical=True, scalar_first=True)
        matrices = sh_rotations(self.rotation)
        bands = [
            matrix @ rest[:, d * d - 1 : (d + 1) ** 2 - 1]
            for d, matrix in enumerate(matrices, 1)
            if (d + 1) ** 2 - 1 <= rest.shape[1]
        ]
        return moved, turned.astype(np.float32), np.concatenate(bands, axis=1) if bands else rest


# PlayCanvas's viewers turn PLY and SOG so.
HALF_TURN = Frame(np.diag([-1.0, -1.0, 1.0]))


def sh_rotations(rotation: Doubles) -> list[NDArray[np.float32]]:
    """The matrices (3, 3), (5, 5), (7, 7) that turn the coefficients of degrees 1 to 3 with the world.

    A turned function has at r the value that the old one has at rotationᵀ·r: for every degree that is linear
    in its coefficients, so a solution over many directions is exact.
    """
    directions = fibonacci_sphere(_SAMPLES)
    new, old = sh_basis(directions), sh_basis(directions @ rotation)
    bands = [slice(d * d - 1, (d + 1) ** 2 - 1) for d in (1, 2, 3)]
    return [np.linalg.lstsq(new[:, b], old[:, b], rcond=None)[0].astype(np.float32) for b in bands]


def sh_basis(directions: Doubles) -> Doubles:
    """(N, 15) the real spherical harmonics of degrees 1 to 3 at unit directions (N, 3), in 3DGS's order."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    columns = [
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z),
        0.31539156525252005 * (2 * zz - xx - yy),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)),
        *(-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z),
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        *(1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy)),
    ]
    return np.stack(columns, axis=1)
