"""What is too far away to say where a camera stood: clouds and hills, which turn as the camera does.

They give the rotation between two panoramas. Where they are most of what is matched, RANSAC has soon found an
epipolar geometry that fits enough, whatever its direction: with the rotation, two matches of what is near
give the direction, where five would rarely be true.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
STILL = 2.0  # errors of a feature: what a rotation explains to that says nothing of where the camera moved
_REFITS = 3  # of a rotation, and of a direction
_TRIALS = 500  # of a direction: enough where one match in ten is true


def common_rotation(one: Array, other: Array, rotation: Array, error: float) -> Array:
    """The rotation (3, 3) that most directions have in common, fitted to those that are within an error.

    Args: one, other (N, 3), directions of matches; rotation (3, 3), one that is near: that of a motion has
        made room for its direction; error, radians that a feature may be off.
    """
    for _ in range(_REFITS):
        fit = angles(one @ rotation.T, other) <= STILL * error
        left, _, right = np.linalg.svd(other[fit].T @ one[fit])
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation


def angles(one: Array, other: Array) -> Array:
    """(N,) radians between directions, (N, 3) both."""
    return np.asarray(np.arccos(np.clip((one * other).sum(axis=1), -1, 1)))


def direction_of_rest(turned: Array, other: Array, error: float) -> tuple[Array, NDArray[np.bool_]]:
    """The direction (3,) towards which most of the matches have moved, and which they are, (N,).

    Each two matches give one: it lies on the great circles along which both have moved.
    Args: turned, other (N, 3), the directions of matches, turned as the camera has, that have moved: none may
        be equal; error, radians that a feature may be off.
    """
    normals = np.cross(turned, other)
    shift = other - turned

    def fitting(directions: Array) -> NDArray[np.bool_]:
        """(K, N) which matches are where one of the directions (K, 3) has led them."""
        reach = 1 - (directions @ turned.T) ** 2  # the squared sine of how far the direction is
        return ((directions @ normals.T) ** 2 <= error**2 * reach) & (directions @ shift.T > 0)

    first, second = np.random.default_rng(0).integers(0, len(turned), (2, _TRIALS))
    tried = np.cross(normals[first], normals[second])[first != second]
    lengths = np.linalg.norm(tried, axis=1, keepdims=True)
    tried = np.concatenate([tried, -tried]) / np.maximum(np.tile(lengths, (2, 1)), np.finfo(float).tiny)
    found = fitting(tried)
    best = int(found.sum(axis=1).argmax())
    direction, fit = tried[best], found[best]
    for _ in range(_REFITS):
        refit = np.linalg.eigh(normals[fit].T @ normals[fit])[1][:, 0]
        refit *= np.sign(refit @ direction) or 1.0
        again = fitting(refit[None])[0]
        if again.sum() < fit.sum():
            break
        direction, fit = refit, again
    return direction, fit
