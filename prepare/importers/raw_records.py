"""What both forms of a COLMAP model share: cameras, checked, and points without an object for each."""

import math
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.importers.poses import Array
from panolog.scene.colmap_check import EQUIRECTANGULAR, PINHOLE, SPHERE, RawCamera
from panolog.scene.errors import SceneError

SIMPLE_PINHOLE = "SIMPLE_PINHOLE"
# COLMAP's id: (name, parameters). 11 is SphereSfM's SPHERE here, whatever COLMAP means by it.
MODELS = {0: (SIMPLE_PINHOLE, 3), 1: (PINHOLE, 4), 11: (SPHERE, 3), 17: (EQUIRECTANGULAR, 2)}
NO_POINT = 2**64 - 1  # the id of an observation that belongs to no point
Entry = tuple[str, int, tuple[float, ...], Array, NDArray[np.uint64]]  # name, camera, pose, (M, 2), (M,) ids


class Points:
    """Points in the order of a file, without an object for each."""

    def __init__(self) -> None:
        self.ids, self.places, self.colors = array("Q"), array("d"), bytearray()

    def add(self, number: int, place: Iterable[float], color: Iterable[int]) -> None:
        self.ids.append(number)
        self.places.extend(place)
        self.colors.extend(color)


def camera(
    path: Path, number: int, model: str, size: tuple[int, int], params: tuple[float, ...]
) -> RawCamera:
    """A camera, checked: a finite one of a known model, and a panorama 2:1 and centred."""
    width, height = size
    where = f"{path}: camera {number} ({model}, {width} x {height})"
    if not (0 < width < 2**20 and 0 < height < 2**20 and all(map(math.isfinite, params))):
        raise SceneError(f"{where} has a size or parameter that cannot be; export the model again")
    if model in (SPHERE, EQUIRECTANGULAR) and width != 2 * height:
        raise SceneError(f"{where} is not 2:1, so it is no full panorama")
    if model == SPHERE and params[1:] != (width / 2, height / 2):
        raise SceneError(f"{where} is no SPHERE of SphereSfM: its centre is not the middle of the image")
    if model in (PINHOLE, SIMPLE_PINHOLE) and not params[0] > 0:
        raise SceneError(f"{where} has no positive focal length; export the model again")
    return RawCamera(number, model, width, height, params)
