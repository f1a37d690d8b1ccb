"""Panoramas that show nothing: black, or of one other colour, which a model learns as it learns a place."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np

from panolog.prepare.provenance import read_mask
from panolog.scene.errors import SceneError
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.model import Scene

_WIDTH, _REDUCTION = 256, 8  # pixels of a panorama as it is looked at; by how much a JPEG is decoded smaller
_PLAIN = 1.0  # of 255: standard deviation of each channel, below which only a compression has made it


def find_blank(scene: Scene) -> list[str]:
    """The names of the panoramas of which what is used is of one colour, in the scene's order.

    One that is masked altogether, or cannot be decoded, counts as none.
    """
    with ThreadPoolExecutor(initializer=cv2.setNumThreads, initargs=(1,)) as threads:
        blank = threads.map(partial(_is_blank, scene), range(len(scene.panoramas)))
        return [panorama.name for panorama, it in zip(scene.panoramas, blank, strict=True) if it]


def _is_blank(scene: Scene, row: int) -> bool:
    panorama, width = scene.panoramas[row], min(_WIDTH, scene.width)
    reduction = _REDUCTION if scene.width >= _REDUCTION * width else 1
    try:
        picture, used = decode_with_alpha(panorama.image, width, reduction)
        if panorama.mask is not None:
            small = cv2.resize(
                read_mask(panorama.mask).astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_AREA
            )
            used = (small > 0) & (True if used is None else used)
    except SceneError:
        return False
    pixels = picture.reshape(-1, 3) if used is None else picture[used]
    return len(pixels) > 0 and float(pixels.std(axis=0).max()) < _PLAIN
