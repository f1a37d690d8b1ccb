"""Image files: sizes and completeness from header and tail without decoding, and decoded pixels."""

import os
import re
import struct
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.scene.errors import ImageError, SceneError
from panolog.scene.pictures.headers import ImageInfo, read_header, without_orientation
from panolog.scene.pictures.jpeg import is_cut
from panolog.scene.pictures.kinds import describe_picture, kind_of
from panolog.scene.pictures.profiles import JPEG, JPEG_SCAN, PNG, chunks, jpeg_segments, to_srgb
from panolog.scene.stores.stored_scenes import whole

_TAIL = 65_536  # bytes searched for the end of a JPEG before the whole file is: cameras append little
_HEAD = 262_144  # bytes in which the pixels of a PNG must begin, if not all of it is there
_IEND = b"\0\0\0\0IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame, all codings
_REDUCED = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
_RECORD = re.compile(rb"tEXtPanoLOG\0([0-9a-f]{64}) ([0-9a-f]{64})")
_RECORD_SEARCHED = 4096  # bytes; it is the second chunk, editors that keep it move it little
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type
_PNG_CHUNKS = 1_000  # before the pixels that are searched for transparency: programs write ten
_BITS = 16  # of a channel of a panorama, at most
_SHOWN = 2**28  # pixels of a picture that is looked at, to say what it is
WHITE = 128  # of a mask, from which on a pixel is white
_NO_ALPHA = b"BM"  # BMP: its fourth channel is undefined in practice
_TIFF = (b"II", b"MM")


def read_info(path: Path) -> ImageInfo:
    """The size of an image, and that its file is complete.

    JPEG, PNG, WebP and usual TIFFs are read at their ends only; any other format is decoded.

    Raises SceneError: the file is missing, truncated or no image; OSError: the file cannot be read.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such image")
    with path.open("rb") as file:
        magic = file.read(8)
        if magic == PNG:
            return _png(path, file)
        if magic.startswith(JPEG):
            return _jpeg(path, file)
        if info := read_header(file):
            return info
    pixels = decode(path, cv2.IMREAD_UNCHANGED)
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    alpha = channels == 4 and not magic.startswith(_NO_ALPHA)
    return ImageInfo(pixels.shape[1], pixels.shape[0], 8 * pixels.itemsize, channels, alpha)


def decode(path: Path, flags: int) -> NDArray[Any]:
    """The pixels of an image file as OpenCV gives them with `flags`: (H, W) or (H, W, channels), BGR.

    Raises ImageError: the file is truncated or cannot be decoded; SceneError: it is missing or cannot be
    read.
    """
    return _decoded(path, _read(path), flags)


def shows_ends(path: Path) -> bool:
    """Whether a file has the header and the end of a JPEG or PNG, whatever is between them.

    Raises OSError if it cannot be read.
    """
    with path.open("rb") as file:
        magic = file.read(8)
        try:
            if magic == PNG:
                pixels_begin = b"IDAT" in file.read(_HEAD)
                file.seek(8)
                return pixels_begin and bool(_png(path, file))
            return magic.startswith(JPEG) and bool(_jpeg(path, file))
        except ImageError:
            return False


def _read(path: Path) -> bytes:
    try:
        data = whole(path)
        return path.read_bytes() if data is None else data
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error


def _decoded(path: Path, data: bytes, flags: int) -> NDArray[Any]:
    """`decode` of what was read from `path`."""
    if data.startswith(JPEG):
        _jpeg(path, BytesIO(data))  # OpenCV fills the missing part of a truncated one with grey
    if data.startswith(_TIFF):
        data = without_orientation(data)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and _chunks_fit(data) else None
    if pixels is not None and data.startswith(JPEG) and is_cut(data, pixels, flags):
        raise _truncated(path)
    if pixels is None:
        tiff = data.startswith(_TIFF) and flags != cv2.IMREAD_UNCHANGED  # one of 32 bits has no colours
        if tiff and (bits := 8 * _decoded(path, data, cv2.IMREAD_UNCHANGED).itemsize) > _BITS:
            raise ImageError(f"{path}: {bits} bits a channel; save it with 8 or 16 bits")
        kind, why = kind_of(data), "the image is damaged or of an unknown format"
        why = f"it is {kind}, whatever its name says; save it as JPEG or PNG" if kind else why
        raise ImageError(f"{path}: cannot be decoded; {why}")
    return pixels


def decode_colors(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) BGR of a picture of any shape, in sRGB and as it is stored. Raises as `decode`."""
    data = _read(path)
    pixels = _decoded(path, data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return to_srgb(np.asarray(pixels, np.uint8), data)


def decode_panorama(path: Path, width: int | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of a panorama, resized to `width` if it is given.

    Poses belong to the pixels as they are stored, so an EXIF orientation does not turn them.

    Raises ImageError: the file is truncated, cannot be decoded or is not 2:1; SceneError: it is missing or
    cannot be read.
    """
    return decode_with_alpha(path, width)[0]


def decode_with_alpha(
    path: Path, width: int | None = None, *, quick: bool = False
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Decodes as `decode_panorama`, with a mask (H, W), True = use: False where fully transparent.

    None where all of it is to be used. A resized pixel that mixes in anything transparent is not used, and
    its colour is that of its parts by how opaque they are, whatever the file has below transparent ones.
    A quick one is decoded at a fraction of its size if it is a JPEG at least twice as wide as `width`. Other
    formats are decoded whole: OpenCV would take a few pixels of each square and leave the others out.

    Raises ImageError, SceneError: as `decode_panorama`.
    """
    data = _read(path)
    reduction = 1
    if quick and width is not None and data.startswith(JPEG):
        given = _jpeg(path, BytesIO(data)).width
        reduction = next(it for it in (8, 4, 2, 1) if given >= 2 * it * width or it == 1)
    pixels = _decoded(path, data, _REDUCED[reduction] | cv2.IMREAD_IGNORE_ORIENTATION)
    found = pixels.shape[1], pixels.shape[0]
    if reduction == 1 and found[0] != 2 * found[1]:
        raise not_a_panorama(path, *found)
    opacity = _opacity(path, data)
    used = None if opacity is None or opacity.all() else opacity > 0
    if opacity is not None and data.startswith(_TIFF):
        pixels = _straight(pixels, opacity)
    pixels = to_srgb(pixels, data)
    if width is not None:
        size = width, width // 2
        pixels = resize(pixels, size) if opacity is None else _resize_opaque(pixels, opacity, size)
        used = None if used is None else resize_used(used, size)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8), used


def not_a_panorama(path: Path, width: int, height: int) -> ImageError:
    """What to raise for a picture of so many pixels, not 2:1: with what it shows, if that is known."""
    what = None
    if width * height <= _SHOWN:
        with suppress(SceneError):  # a damaged one is none either
            what = describe_picture(decode(path, cv2.IMREAD_REDUCED_GRAYSCALE_8))
    shown = f"; it shows {what}" if what else ""
    return ImageError(f"{path}: {width} x {height} pixels are not 2:1: not a panorama{shown}")


def decode_used(path: Path) -> NDArray[np.bool_] | None:
    """(H, W) True = use, of a picture's alpha channel: as `decode_with_alpha` without resizing.

    Raises ImageError, SceneError: as `decode_panorama`.
    """
    opacity = _opacity(path, _read(path))
    return None if opacity is None or opacity.all() else opacity > 0


def decode_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) True = use, of a mask: neither black nor transparent.

    White may be 255 or 1. Where there is white, what is darker than half of it is black, as at edges and in
    JPEGs; in a map of classes, without white, 0 is.

    Raises ImageError, SceneError: as `decode`.
    """
    pixels = decode(path, cv2.IMREAD_UNCHANGED)
    opaque = np.ones(pixels.shape[:2], bool)
    if pixels.ndim == 3:
        if pixels.shape[2] == 4:
            opaque = pixels[..., 3] >= WHITE
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_BGR2GRAY)
    return np.asarray(opaque & (pixels >= (WHITE if pixels.max(initial=0) >= WHITE else 1)))


def resize_used(used: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask (H, W), True = use, at `size`: a pixel that mixes in anything to be ignored is to be ignored."""
    return np.asarray(resize(used.astype(np.float32), size) > 0.999)


def _opacity(path: Path, data: bytes) -> NDArray[np.uint8] | None:
    """The alpha channel (H, W) of what was read from `path`, 255 opaque; None if all of it is opaque."""
    if data.startswith((JPEG, _NO_ALPHA)) or (data.startswith(PNG) and not _png_alpha(BytesIO(data))):
        return None
    header = read_header(BytesIO(data))
    if header is not None and not header.alpha:
        return None
    pixels = _decoded(path, data, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        return None
    alpha = pixels[..., 3]
    if alpha.dtype == np.uint16:
        alpha = np.where(alpha > 0, np.maximum(alpha >> 8, 1), 0)  # what is hardly there is not nothing
    elif alpha.dtype != np.uint8:
        return None
    return None if alpha.min() == 255 else np.ascontiguousarray(alpha, np.uint8)


def _straight(pixels: NDArray[Any], opacity: NDArray[np.uint8]) -> NDArray[Any]:
    """Colours (H, W, 3) of a TIFF, which libtiff has multiplied by their opacity (H, W)."""
    partly = (opacity > 0) & (opacity < 255)
    pixels[partly] = np.minimum(np.rint(pixels[partly] * (255 / opacity[partly])[:, None]), 255)
    return pixels


def _resize_opaque(pixels: NDArray[Any], opacity: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[Any]:
    """`resize` of colours (H, W, 3), each pixel weighed by its opacity (H, W)."""
    resized = resize(pixels, size)
    weight = opacity.astype(np.float32)
    total = resize(weight, size)
    for channel in range(3):
        mixed = resize(pixels[..., channel] * weight, size)
        mean = np.divide(mixed, total, out=np.zeros_like(total), where=total > 0)
        resized[..., channel] = np.where(total > 0, np.rint(mean), resized[..., channel])
    return resized


def resize(pixels: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """To `size` = (width, height): the mean over each new pixel when it shrinks, bilinear when it grows."""
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    shrinks = size[0] < pixels.shape[1]
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def check_images(paths: Sequence[Path]) -> tuple[int, int]:
    """(width, height) that all panoramas share. Raises SceneError as `read_infos` does."""
    first = read_infos(paths)[0]
    return first.width, first.height


def read_infos(paths: Sequence[Path]) -> list[ImageInfo]:
    """The headers of panoramas, which all have one size.

    Raises SceneError: a file is missing, truncated or of another size than the first, or they are not 2:1.
    """
    if missing := [path for path in paths if not path.is_file()]:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise SceneError(
            f"{missing[0]}: the model names this image, but it is missing{more}; `panolog scene import` also "
            "finds images in other folders, of other formats, and with endings in another case"
        )
    infos = [read_info(path) for path in paths]
    width, height = infos[0].width, infos[0].height
    for path, info in zip(paths, infos, strict=True):
        if info.width != 2 * info.height:
            raise not_a_panorama(path, info.width, info.height)
        if info.bits > _BITS:
            raise SceneError(f"{path}: {info.bits} bits a channel; save it with 8 or 16 bits")
        if info.width != width:
            raise SceneError(
                f"{path}: {info.width} x {info.height} pixels, but {paths[0].name} has {width} x {height}; "
                "all panoramas must have one size"
            )
    return infos


def check_layer(paths: Sequence[Path | None], bits: int) -> None:
    """Checks masks (up to 8 bit) or depth maps (16 bit): whole, 2:1; depth maps have one channel.

    Raises SceneError: one of them is not.
    """
    for path in filter(None, paths):
        info = read_info(path)
        if info.bits not in (range(1, 9) if bits == 8 else (bits,)):  # PIL writes booleans as one bit
            raise SceneError(f"{path}: {info.bits} bits a channel; save it with {bits} bits")
        if bits == 16 and info.channels != 1:
            raise SceneError(f"{path}: {info.channels} channels, but a depth map has one; save it as grey")
        if info.width != 2 * info.height:
            raise SceneError(f"{path}: {info.width} x {info.height} pixels are not 2:1 like the panoramas")


def layer_record(path: Path) -> tuple[str, str] | None:
    """The record in a layer that PanoLOG made: key and digest (`prepare.provenance`); None without one.

    Raises OSError: the file is missing or cannot be read.
    """
    with path.open("rb") as file:
        found = _RECORD.search(file.read(_RECORD_SEARCHED))
    return None if found is None else (found[1].decode(), found[2].decode())


def _chunks_fit(data: bytes) -> bool:
    """Whether a PNG has all its chunks, each as long as it says: OpenCV allocates that much, then checks."""
    if not data.startswith(PNG):
        return True
    file = BytesIO(data)
    file.seek(8)
    ends = (file.tell() + size + 4 for kind, size in chunks(file, png=True) if kind == b"IEND")  # a checksum
    return next(ends, len(data) + 1) <= len(data)


def _truncated(path: Path) -> ImageError:
    return ImageError(f"{path}: the image is truncated; copy it again")


def _png(path: Path, file: BinaryIO) -> ImageInfo:
    header = file.read(18)  # length, IHDR, width, height, bits, colour type
    file.seek(0, os.SEEK_END)
    file.seek(max(0, file.tell() - _TAIL))
    if len(header) < 18 or _IEND not in file.read():
        raise _truncated(path)
    width, height, bits, color = struct.unpack(">8xIIBB", header)
    return ImageInfo(width, height, bits, _PNG_CHANNELS.get(color, 0), _png_alpha(file))


def _png_alpha(file: BinaryIO) -> bool:
    """Whether a PNG has an alpha channel, or a chunk tRNS before its pixels."""
    file.seek(25)  # signature, length, IHDR, width, height, bits
    color = file.read(1)
    if color in (b"\4", b"\6"):
        return True
    file.seek(33)
    kinds = (kind for kind, _ in islice(chunks(file, png=True), _PNG_CHUNKS))
    return b"tRNS" in takewhile(lambda kind: kind != b"IDAT", kinds)


def _jpeg(path: Path, file: BinaryIO) -> ImageInfo:
    info = None
    for marker, _ in jpeg_segments(file):
        if marker in _JPEG_SIZES and len(header := file.read(6)) == 6:
            bits, height, width, channels = struct.unpack(">BHHB", header)
            info = ImageInfo(width, height, bits, channels)
        elif marker == JPEG_SCAN and info is not None and _has_end(file):
            return info
    raise _truncated(path)


def _has_end(file: BinaryIO) -> bool:
    """Whether the end marker follows: inside a scan its two bytes cannot occur, after it trailers may."""
    scan = file.tell()
    size = file.seek(0, os.SEEK_END)
    for start in (max(scan, size - _TAIL), scan):
        file.seek(start)
        if _JPEG_END in file.read():
            return True
    return False
