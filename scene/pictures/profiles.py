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

PNG, JPEG, JPEG_SCAN = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", 0xDA
_APP2, _JPEG_HEAD, _TIFF = 0xE2, b"ICC_PROFILE\0", (b"II*\0", b"MM\0*")
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
    file = BytesIO(data)
    try:
        if data.startswith(JPEG):
            return _of_jpeg(file)
        if data.startswith(PNG):
            return _of_png(file)
        if is_webp(data):
            file.seek(12)
            return next((file.read(size) for kind, size in chunks(file, png=False) if kind == b"ICCP"), None)
        if data.startswith(_TIFF):
            tags = Image.Exif()
            tags.load_from_fp(file)
            tag = tags.get(_TIFF_TAG)
            return tag if isinstance(tag, bytes) else None
    except _DAMAGE:
        pass
    return None


def is_webp(head: bytes) -> bool:
    """Whether a file that begins so is a WebP, whose chunks begin at its byte 12."""
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def jpeg_segments(file: BinaryIO) -> Iterator[tuple[int, int]]:
    """(marker, bytes after its length field) of a JPEG up to its scan; the file is at them each time."""
    file.seek(2)
    while True:
        head = file.read(4)
        while len(head) == 4 and head[:2] == b"\xff\xff":  # fill bytes
            head = head[1:] + file.read(1)
        if len(head) < 4 or head[0] != 0xFF:
            return
        length = max(0, int.from_bytes(head[2:], "big") - 2)
        after = file.tell() + length
        yield head[1], length
        if head[1] == JPEG_SCAN:
            return
        file.seek(after)


def chunks(file: BinaryIO, *, png: bool) -> Iterator[tuple[bytes, int]]:
    """(kind, bytes) of the chunks of a PNG or WebP from where the file is; it is at each one's content."""
    while len(head := file.read(8)) == 8:
        kind, size = struct.unpack(">I4s", head)[::-1] if png else struct.unpack("<4sI", head)
        after = file.tell() + size + (4 if png else size % 2)  # a checksum, or a byte that makes it even
        yield kind, size
        file.seek(after)


def _of_jpeg(file: BinaryIO) -> bytes | None:
    """The profile in APP2 segments, each with its number, from 1 on, and how many there are."""
    parts = dict[int, bytes]()
    for marker, length in jpeg_segments(file):
        if marker == _APP2 and file.read(len(_JPEG_HEAD)) == _JPEG_HEAD:
            number, _ = file.read(2)
            parts[number] = file.read(length - len(_JPEG_HEAD) - 2)
    return b"".join(parts[number] for number in sorted(parts)) or None


def _of_png(file: BinaryIO) -> bytes | None:
    """The profile in the chunk iCCP: a name, a zero, the compression, 0, and the compressed profile."""
    file.seek(8)
    for kind, size in chunks(file, png=True):
        if kind == b"iCCP":
            packed = file.read(size).split(b"\0", 1)[1][1:]
            return zlib.decompressobj().decompress(packed, _LARGEST)
        if kind == b"IDAT":
            break
    return None


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
