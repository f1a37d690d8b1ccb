"""Conversion of poses to our convention: camera x right, y down, z forward, world-to-camera."""

import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import SceneError

Array = NDArray[np.float64]
FLIP_YZ = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera (x right, y up, z backward) to ours, and back
_TOLERANCE = 1e-3  # how far from orthonormal a rotation that was written as text may be


def nearest_rotation(where: str, matrix: Array) -> Array:
    """(3, 3) the rotation nearest to `matrix` (3, 3).

    Raises SceneError: it is none, even roughly, or it mirrors; `where` says which field it is.
    """
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _TOLERANCE:
        raise SceneError(f"{where}: is not a rotation (its rows are not orthonormal); export it again")
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if np.linalg.det(nearest) < 0:
        raise SceneError(f"{where}: mirrors (its determinant is -1), so it is not a camera pose")
    return nearest


def pose_from_camera_to_world(where: str, matrix: Array, axes: Array) -> tuple[Array, Array]:
    """(rotation, translation), world-to-camera, of a camera-to-world matrix (3 or 4, 4).

    `axes` (3, 3) maps our camera axes to those of the format: `FLIP_YZ` or the identity. A uniform scale in
    the matrix is taken out, as it has no meaning for a camera.

    Raises SceneError: its left part is not a rotation.
    """
    scale = np.cbrt(abs(np.linalg.det(matrix[:3, :3])))
    if not 1e-9 < scale < 1e9:
        raise SceneError(f"{where}: is not a pose (its determinant is {scale**3:.3g}); export it again")
    turned = nearest_rotation(where, matrix[:3, :3] / scale) @ axes
    return turned.T, -turned.T @ matrix[:3, 3]
