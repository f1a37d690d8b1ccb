"""Stills that are no whole panoramas as they are stored: cropped ones are completed, turned ones are refused.

Cameras and stitchers that do not see the zenith or the nadir write the part that they have, and where in the
full panorama it is (`Exif.crop`). It is put there, and the rest is transparent, which is a mask.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile, remade
from panolog.prepare.provenance import MAX_BYTES
from panolog.prepare.world.exif import Crop, Exif, essential_exif, read_exif
from panolog.prepare.world.image_blocks import with_metadata
from panolog.scene.errors import SceneError
from panolog.scene.image_files import decode_colors, decode_used, read_info
from panolog.scene.pictures.headers import ImageInfo
from panolog.scene.write import Progress, no_progress

_QUALITY = 95  # of a JPEG


def complete_panoramas(
    panoramas: Sequence[PanoramaFile], folder: Path, progress: Progress = no_progress
) -> tuple[PanoramaFile, ...]:
    """The panoramas, of which cropped ones are whole: as PNG in `folder`, with position, time and exposure.

    What an earlier call has completed is not done again.

    Raises SceneError: a picture is to be turned by its EXIF orientation, or its crop does not fit it;
    OSError: a file cannot be read or written.
    """
    exifs = [read_exif(panorama.path) for panorama in panoramas]  # not in threads, see there
    for panorama, exif in zip(panoramas, exifs, strict=True):
        if exif.orientation != 1:
            raise SceneError(
                f"{panorama.path}: its EXIF orientation {exif.orientation} turns or mirrors it, and poses "
                "belong to pixels as they are stored; turn them with `mogrify -auto-orient FILE`, or, if "
                "they are upright, remove the entry with `exiftool -Orientation= FILE`"
            )
    crops = {
        row: it for row, exif in enumerate(exifs) if (it := _crop(panoramas[row].path, exif)) is not None
    }

    def complete(row: int, output: Path) -> None:
        path = panoramas[row].path
        output.write_bytes(derived(path, exifs[row], _placed(path, crops[row]), ".png"))

    return remade(panoramas, dict.fromkeys(crops, ".png"), folder, complete, progress)


def whole_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels of what `complete_panoramas` makes of a picture. Raises SceneError."""
    info, crop = read_info(path), _crop(path, read_exif(path))
    if crop is None:
        return info.width, info.height
    height = _full_height(info, crop)
    return 2 * height, height


def _crop(path: Path, exif: Exif) -> Crop | None:
    """How a picture is cropped; None if nothing is missing. Raises SceneError as `_is_cropped`."""
    crop = exif.crop
    return None if crop is None or crop.is_whole or not _is_cropped(path, crop) else crop


def _is_cropped(path: Path, crop: Crop) -> bool:
    """Whether a picture is what its crop says; False if a program has completed it and left the entry.

    Raises SceneError if it is neither, or the full panorama is none or larger than any.
    """
    info = read_info(path)
    if abs(info.width * crop.size[1] - info.height * crop.size[0]) > max(crop.size):  # by more than a pixel
        if info.width == 2 * info.height:
            return False
        raise SceneError(
            f"{path}: {info.width} x {info.height} pixels, but its GPano says {crop.size[0]} x "
            f"{crop.size[1]} of {crop.full[0]} x {crop.full[1]}; export it again as a whole panorama"
        )
    width, height = crop.full
    if abs(width - 2 * height) > 1:
        raise SceneError(f"{path}: its GPano says {width} x {height} of a full panorama, which is not 2:1")
    if 2 * _full_height(info, crop) ** 2 * 4 > MAX_BYTES or info.width * info.height * 4 > MAX_BYTES:
        raise SceneError(
            f"{path}: its GPano says {width} x {height} pixels, more than any panorama has; scale it down"
        )
    return True


def _full_height(info: ImageInfo, crop: Crop) -> int:
    """Rows of the full panorama at the scale of the picture."""
    return round(crop.full[1] * info.width / crop.size[0])


def derived(path: Path, exif: Exif, pixels: NDArray[np.uint8], suffix: str) -> bytes:
    """What was made of a picture as a file, with the picture's place, time, exposure and attitude.

    Args: path, of the picture; exif, its own; pixels (H, W, 3) BGR, or (H, W, 4) with opacity; suffix, .png
        or .jpg.
    """
    options = (cv2.IMWRITE_PNG_COMPRESSION, 1) if suffix == ".png" else (cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
    encoded = bytes(cv2.imencode(suffix, pixels, options)[1])
    xmp = None if exif.attitude is None else exif.attitude.packet
    return with_metadata(encoded, essential_exif(path), xmp)


def _placed(path: Path, crop: Crop) -> NDArray[np.uint8]:
    """(H, 2 H, 4) BGR and opacity of the full panorama; transparent where the picture has nothing."""
    pixels = decode_colors(path)
    used = decode_used(path)
    height = _full_height(read_info(path), crop)
    scale = height / crop.full[1]
    left, right = (round(scale * column) for column in (crop.left, crop.left + crop.size[0]))
    top, bottom = (round(scale * row) for row in (crop.top, crop.top + crop.size[1]))
    right, bottom = min(right, 2 * height), min(bottom, height)
    size = right - left, bottom - top
    if (pixels.shape[1], pixels.shape[0]) != size:  # by a pixel, where the picture was scaled
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        used = None if used is None else cv2.resize(used.view(np.uint8), size) > 0
    full = np.zeros((height, 2 * height, 4), np.uint8)
    full[top:bottom, left:right, :3] = pixels
    full[top:bottom, left:right, 3] = 255 if used is None else np.where(used, 255, 0)
    return full
