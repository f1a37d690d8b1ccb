"""Stills that are no whole panoramas as they are stored: cropped ones are completed, turned ones are refused.

Cameras and stitchers that do not see the zenith or the nadir write the part that they have, and where in the
full panorama it is (`Exif.crop`). It is put there, and the rest is transparent, which is a mask.
"""

import os
import struct
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.provenance import MAX_BYTES
from panolog.prepare.world.exif import Crop, Exif, essential_exif, read_exif
from panolog.prepare.world.image_blocks import EXIF_HEAD, XMP_HEAD, with_segments
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic, stem_of
from panolog.scene.image_files import decode_colors, decode_used, read_info
from panolog.scene.pictures.headers import ImageInfo
from panolog.scene.write import Progress, no_progress

_THREADS = min(4, os.cpu_count() or 1)  # each holds a whole panorama
_HEADER = 33  # bytes of a PNG before its second chunk
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

    def complete(panorama: PanoramaFile, exif: Exif) -> PanoramaFile:
        crop = exif.crop
        if crop is None or crop.is_whole or not _is_cropped(panorama.path, crop):
            return panorama
        name = f"{stem_of(panorama.name)}.png"
        return PanoramaFile(panorama.root, name, _completed(panorama.path, exif, crop, folder / name))

    found = []
    with ThreadPoolExecutor(_THREADS, "complete") as pool:
        for panorama in pool.map(complete, panoramas, exifs):
            found.append(panorama)
            progress(len(found), len(panoramas))
    return tuple(found)


def whole_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels of what `complete_panoramas` makes of a picture. Raises SceneError."""
    info, crop = read_info(path), read_exif(path).crop
    if crop is None or crop.is_whole or not _is_cropped(path, crop):
        return info.width, info.height
    height = _full_height(info, crop)
    return 2 * height, height


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


def _completed(path: Path, exif: Exif, crop: Crop, output: Path) -> Path:
    """Writes the full panorama of a cropped one, unless it is there; the time of both files is the same."""
    changed = path.stat().st_mtime_ns
    if output.is_file() and output.stat().st_mtime_ns == changed:
        return output
    write_derived(path, exif, _placed(path, crop), output)
    return output


def write_derived(path: Path, exif: Exif, pixels: NDArray[np.uint8], output: Path) -> None:
    """Writes what was made of a picture, as PNG or JPEG by its suffix.

    With the picture's place, time, exposure and attitude, and the time of its file.

    Args: path, of the picture; exif, its own; pixels (H, W, 3) BGR, or (H, W, 4) with opacity.
    Raises: OSError, it cannot be written.
    """
    changed, block = path.stat().st_mtime_ns, essential_exif(path)
    if output.suffix == ".png":
        encoded = bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
        chunks = b"" if block is None else _chunk(b"eXIf", block)
        if exif.attitude is not None:
            chunks += _chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + exif.attitude.packet)
        encoded = encoded[:_HEADER] + chunks + encoded[_HEADER:]
    else:
        segments = [] if block is None else [EXIF_HEAD + block]
        segments += [] if exif.attitude is None else [XMP_HEAD + exif.attitude.packet]
        encoded = bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])
        encoded = with_segments(encoded, *segments)
    output.parent.mkdir(parents=True, exist_ok=True)
    with atomic(output) as temporary:
        temporary.write_bytes(encoded)
        os.utime(temporary, ns=(changed, changed))


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


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
