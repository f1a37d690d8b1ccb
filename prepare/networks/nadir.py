"""The nadir: what is around straight down, and the black cap that stitchers leave there."""

from collections.abc import Iterable
from math import ceil

import numpy as np
from numpy.typing import NDArray

_BLACK = 8  # of 255: JPEG writes black as up to that near an edge
_ROW = 0.995  # of the pixels of a row must be black: the rim is rough
_LEAST = 3.0  # degrees that a cap has at least: below, it costs nothing
_RIM = 1.5  # rows above the cap in which it is mixed in


def nadir_cone(height: int, degrees: float) -> NDArray[np.bool_]:
    """(height, 2 height) what is within `degrees` of straight down."""
    angle = 180 - (np.arange(height) + 0.5) / height * 180
    return np.repeat((angle <= degrees)[:, None], 2 * height, axis=1)


def black_nadir(panoramas: Iterable[NDArray[np.uint8]]) -> float | None:
    """The angle from straight down, in degrees, within which all of the panoramas (H, 2 H, 3) are black.

    Cameras that do not see what is below them give such pictures: a cap without alpha channel. The angle has
    a margin for the rim. None without a panorama, or where one of them is not black.
    """
    found = min(map(_black_angle, panoramas), default=None)
    return None if found is None or found < _LEAST else found


def _black_angle(panorama: NDArray[np.uint8]) -> float:
    """The angle of `black_nadir` for one panorama; 0 where it is not black."""
    lower = panorama[len(panorama) // 2 :]
    black = (lower.max(axis=2) <= _BLACK).mean(axis=1) >= _ROW
    rows = int(np.argmin(black[::-1])) if not black.all() else 0  # all: a picture of the night
    return ceil((rows + _RIM) * 180 / len(panorama) * 2) / 2 if rows else 0.0
