"""Colour profiles (ICC) in pictures: colours are converted to sRGB, which all that follows takes them for.

By Little CMS, relative colorimetric. A picture without a profile is taken to be sRGB, and so is one whose
profile is damaged, or of CMYK, which OpenCV has converted already.
"""

import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from panolog.scene.pictures.headers import DAMAGE

_JPEG, _JPEG_SCAN, _APP2, _JPEG_HEAD = b"\xff\xd8", 0xDA, 0xE2, b"ICC_PROFILE\0"
_PNG, _TIFF = b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*")
_TIFF_TAG = 34675  # InterColorProfile
_LARGEST = 2**24  # bytes of a profile; those with tables have some megabytes
_MODES = {"RGB": "RGB", "GRAY": "L"}  # of Pillow, by the colours of a profile
_CLOSE = 1  # of 255: a profile that changes no colour by more is sRGB's own
_PIXELS = 2**20  # that are converted at a time
_DAMAGE = (*DAMAGE, zlib.error)


class _Conversion(NamedTuple):
    mode: str
    transform: ImageCms.ImageCmsTransform


def to_srgb(pixels: NDArray[np.uint8], data: bytes) -> NDArray[np.uint8]:
    """Pixels (H, W, 3) BGR in the colours of the profile in `data`, the file that they were decoded from."""
    profile = embedded_profile(data)
    conversion = None if profile is None else _conversion(profile)
    if conversion is None:
        return pixels
    found, rows = np.empty_like(pixels), max(1, _PIXELS // pixels.shape[1])
    for start in range(0, len(pixels), rows):
        part = pixels[start : start + rows, :, ::-1]
        found[start : start + rows] = _converted(np.ascontiguousarray(part), conversion)[..., ::-1]
    return found


def in_srgb(picture: Image.Image) -> Image.Image:
    """A picture of Pillow, of any mode, as RGB in sRGB."""
    profile = picture.info.get("icc_profile")
    conversion = _conversion(profile) if isinstance(profile, bytes) else None
    if conversion is None:
        return picture.convert("RGB")
    return _applied(picture.convert(conversion.mode), conversion)


def embedded_profile(data: bytes) -> bytes | None:
    """The ICC profile in a JPEG, PNG, WebP or TIFF; None if there is none, or it is damaged."""
    try:
        if data.startswith(_JPEG):
            return _of_jpeg(BytesIO(data))
        if data.startswith(_PNG):
            return _of_png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            found = (data[at : at + size] for kind, at, size in _chunks(data, 12) if kind == b"ICCP")
            return next(found, None)
        if data.startswith(_TIFF):
            tags = Image.Exif()
            tags.load_from_fp(BytesIO(data))
            tag = tags.get(_TIFF_TAG)
            return tag if isinstance(tag, bytes) else None
    except _DAMAGE:
        pass
    return None


def jpeg_segments(file: BinaryIO) -> Iterator[tuple[int, int]]:
    """(marker, bytes after its length field) of a JPEG up to its scan; the file is then at those bytes."""
    file.seek(2)
    while True:
        head = file.read(4)
        while len(head) == 4 and head[:2] == b"\xff\xff":  # fill bytes
            head = head[1:] + file.read(1)
        if len(head) < 4 or head[0] != 0xFF:
            return
        yield head[1], max(0, int.from_bytes(head[2:], "big") - 2)
        if head[1] == _JPEG_SCAN:
            return


def _of_jpeg(file: BinaryIO) -> bytes | None:
    """The profile in APP2 segments, each with its number, from 1 on, and how many there are."""
    parts = dict[int, bytes]()
    for marker, length in jpeg_segments(file):
        after = file.tell() + length
        if marker == _APP2 and file.read(len(_JPEG_HEAD)) == _JPEG_HEAD:
            number, _ = file.read(2)
            parts[number] = file.read(after - file.tell())
        file.seek(after)
    return b"".join(parts[number] for number in sorted(parts)) or None


def _of_png(data: bytes) -> bytes | None:
    """The profile in the chunk iCCP: a name, a zero, the compression, 0, and the compressed profile."""
    for kind, at, size in _chunks(data, 8):
        if kind == b"iCCP":
            packed = data[at : at + size].split(b"\0", 1)[1][1:]
            return zlib.decompressobj().decompress(packed, _LARGEST)
        if kind == b"IDAT":
            break
    return None


def _chunks(data: bytes, at: int) -> Iterator[tuple[bytes, int, int]]:
    """(kind, where its content begins, bytes) of the chunks of a PNG or a WebP from `at` on."""
    png = data.startswith(_PNG)
    while at + 8 <= len(data):
        if png:
            size, kind = struct.unpack_from(">I4s", data, at)
        else:
            kind, size = struct.unpack_from("<4sI", data, at)
        yield kind, at + 8, size
        at += 8 + size + (4 if png else size % 2)  # a checksum, or a byte that makes the size even


@lru_cache(maxsize=16)
def _conversion(profile: bytes) -> _Conversion | None:
    """The conversion from a profile to sRGB; None if it changes nothing, or cannot be made."""
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        mode = _MODES[source.profile.xcolor_space.strip()]
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        target = ImageCms.createProfile("sRGB")
        found = _Conversion(mode, ImageCms.buildTransform(source, target, mode, "RGB", intent))
    except (KeyError, OSError, ImageCms.PyCMSError):
        return None
    steps = np.linspace(0, 255, 6).astype(np.uint8)
    if mode == "L":
        colors = np.repeat(steps[None, :, None], 3, axis=2)
    else:
        colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
    changed = np.abs(_converted(colors, found).astype(int) - colors).max()
    return found if changed > _CLOSE else None


def _converted(pixels: NDArray[np.uint8], conversion: _Conversion) -> NDArray[np.uint8]:
    """Pixels (H, W, 3) RGB in sRGB. Those of a grey picture have three equal channels."""
    plain = pixels if conversion.mode == "RGB" else np.ascontiguousarray(pixels[..., 0])
    return np.asarray(_applied(Image.fromarray(plain), conversion), np.uint8)


def _applied(picture: Image.Image, conversion: _Conversion) -> Image.Image:
    found = ImageCms.applyTransform(picture, conversion.transform)
    assert found is not None  # only a picture that is changed in place is not returned
    return found
