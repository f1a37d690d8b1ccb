"""RUN/prepare/masks.jpg: some panoramas of a scene with what their masks leave out in red."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.orchestrator.watch.views.queries import spread
from panolog.prepare.panorama_files import PanoramaFile, load_resized
from panolog.prepare.provenance import read_mask
from panolog.scene.files import write_bytes
from panolog.scene.read import MASKS

_WIDTH, _COLUMNS, _MOST = 480, 3, 12  # pixels of each panorama; panoramas in a row, and in all
_GAP, _GREY = 6, 128
_RED = np.array([208, 40, 40], np.float32)
_TINT = 0.6  # share of red where a pixel is left out
_QUALITY = 85


def write_mask_picture(path: Path, panoramas: Sequence[PanoramaFile]) -> None:
    """Writes the picture, atomically: at most 12 of the panoramas, evenly chosen.

    Raises SceneError if a panorama or a mask is damaged; OSError if the picture cannot be written.
    """
    tiles = [_tile(panorama) for panorama in spread(panoramas, _MOST)]
    columns = min(_COLUMNS, len(tiles))
    height = -(-len(tiles) // columns)
    sheet = np.full(
        (height * (_WIDTH // 2 + _GAP) - _GAP, columns * (_WIDTH + _GAP) - _GAP, 3), _GREY, np.uint8
    )
    for number, tile in enumerate(tiles):
        top, left = number // columns * (_WIDTH // 2 + _GAP), number % columns * (_WIDTH + _GAP)
        sheet[top : top + _WIDTH // 2, left : left + _WIDTH] = tile
    encoded = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    write_bytes(path, bytes(encoded))


def _tile(panorama: PanoramaFile) -> NDArray[np.uint8]:
    """(height, width, 3) RGB of a panorama with its mask."""
    picture = load_resized(panorama.path, _WIDTH)
    mask = panorama.layer(MASKS)
    if not mask.is_file():
        return picture
    used = read_mask(mask)
    out = cv2.resize((~used).astype(np.float32), (_WIDTH, _WIDTH // 2), interpolation=cv2.INTER_AREA)
    share = _TINT * out[..., None]
    return np.asarray(picture * (1 - share) + _RED * share, np.uint8)
