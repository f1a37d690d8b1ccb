"""Panoramas that show nothing: black, or of one other colour, which a model learns as it learns a place."""

from functools import partial

import cv2
import numpy as np

from panolog.prepare.check.evidence import in_threads
from panolog.prepare.provenance import read_mask
from panolog.scene.errors import SceneError
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.model import Scene

_WIDTH = 256  # pixels of a panorama as it is looked at
_PLAIN = 1.0  # of 255: standard deviation of each channel, below which only a compression has made it


def find_blank(scene: Scene) -> list[str]:
    """The names of the panoramas of which what is used is of one colour, in the scene's order.

    One that is masked altogether, or cannot be decoded, counts as none.
    """
    blank = in_threads(partial(_is_blank, scene), range(len(scene.panoramas)))
    return [panorama.name for panorama, it in zip(scene.panoramas, blank, strict=True) if it]


def _is_blank(scene: Scene, row: int) -> bool:
    mask = scene.panoramas[row].mask
    try:
        picture, used = decode_with_alpha(scene.panoramas[row].image, min(_WIDTH, scene.width), quick=True)
        if mask is not None:
            small = cv2.resize(
                read_mask(mask).astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_AREA
            )
            used = (small > 0) & (True if used is None else used)
    except SceneError:
        return False
    pixels = picture.reshape(-1, 3) if used is None else picture[used]
    return len(pixels) > 0 and float(pixels.std(axis=0).max()) < _PLAIN
