"""PNG layers that record what they were made from, so that files of the user are never overwritten.

The record is a PNG text chunk: a key for all that the layer was made from, and a digest of the pixels. If the
pixels were changed since, in any editor, the digest does not match and the file counts as the user's own.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.world.image_blocks import with_chunks
from panolog.scene.errors import InputError, SceneError
from panolog.scene.image_files import decode, decode_mask, layer_record, not_a_panorama, read_info
from panolog.scene.pictures.headers import ImageInfo

MAX_BYTES = 2**29  # of pixels, 18,900 x 9,450 in colour: more than any camera has
_KEYWORD = b"PanoLOG\0"


def png_with_provenance(pixels: NDArray[np.uint8] | NDArray[np.uint16], key: str) -> bytes:
    """The bytes of a grey PNG of `pixels` (H, W), with a record of `key`, 64 hexadecimal digits."""
    encoded = bytes(cv2.imencode(".png", pixels)[1])
    return with_chunks(encoded, (b"tEXt", _KEYWORD + f"{key} {_digest(pixels)}".encode()))


@dataclass(frozen=True)
class Provenance:
    """The origin of a layer that PanoLOG made."""

    key: str  # of all that it was made from
    state: Literal["intact", "changed", "damaged"]  # "changed" by a user since


def read_provenance(path: Path) -> Provenance | None:
    """The provenance of a layer; None of a file without one, which is the user's own, and without a file.

    Raises OSError: the file is there but cannot be read.
    """
    if not path.is_file():
        return None
    found = layer_record(path)
    if found is None:
        return None
    key, digest = found
    try:
        same = digest == _digest(read_layer(path))
    except InputError:
        return Provenance(key, "damaged")
    return Provenance(key, "intact" if same else "changed")


def is_user_file(path: Path) -> bool:
    """Whether the file exists and a user made or changed it: never to be overwritten. Raises OSError."""
    found = read_provenance(path)
    return path.is_file() if found is None else found.state == "changed"


def read_layer(path: Path) -> NDArray[Any]:
    """The pixels (H, W) of a layer, as they are stored.

    Raises SceneError: it is damaged, or larger than any panorama.
    """
    check_panorama_size(path, read_info(path))
    pixels = decode(path, cv2.IMREAD_UNCHANGED)
    return pixels if pixels.ndim == 2 else decode(path, cv2.IMREAD_GRAYSCALE)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) True = use: `decode_mask` of a file that is not larger than any panorama. Raises SceneError."""
    check_panorama_size(path, read_info(path))
    return decode_mask(path)


def sampled(layer: NDArray[np.bool_], where: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) the pixels of a layer (H, W) at fractions (N, 2) of its width and height."""
    height, width = layer.shape
    column, row = (where * (width, height)).astype(np.int64).T
    found: NDArray[np.bool_] = layer[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return found


def check_panorama_size(path: Path, info: ImageInfo) -> None:
    """Refuses what is not a panorama, before any memory is spent on it. Raises SceneError."""
    if info.width != 2 * info.height or not info.width:
        raise not_a_panorama(path, info.width, info.height)
    if (size := info.width * info.height * info.channels * info.bits // 8) > MAX_BYTES:
        raise SceneError(
            f"{path}: its header says {info.width} x {info.height} pixels of {info.channels} channels with "
            f"{info.bits} bits, {size / 2**20:,.0f} MiB and more than any panorama has ({MAX_BYTES >> 20}); "
            "scale it down, save it with 8 bits and without alpha, or copy it again if it is damaged"
        )


def _digest(pixels: NDArray[Any]) -> str:
    return hashlib.sha256(repr((pixels.shape, pixels.dtype.str)).encode() + pixels.tobytes()).hexdigest()
