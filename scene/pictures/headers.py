"""Headers of TIFF and WebP: sizes of pictures that would take a second to decode, and how they are turned."""

import os
import struct
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, BinaryIO

from PIL import ExifTags
from PIL import TiffImagePlugin as Tiff

# What Pillow raises for a damaged file.
DAMAGE = (SyntaxError, ValueError, LookupError, TypeError, ArithmeticError, OSError, struct.error)
_CHANNELS = {1: (1,), 2: (3, 4), 6: (3,)}  # of TIFF by photometric interpretation: grey, RGB, YCbCr
_WEBP = 30  # bytes, with the size in any of its three kinds


@dataclass(frozen=True)
class ImageInfo:
    """The header of an image file."""

    width: int
    height: int
    bits: int  # of one channel
    channels: int
    alpha: bool = False  # whether some of its pixels may be transparent


def read_header(file: BinaryIO) -> ImageInfo | None:
    """The header of a TIFF or WebP whose file has all that it points to.

    None where only decoding says more: of other formats, truncated files and rare kinds of pixels.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(_WEBP)
    try:
        if head[:2] in (Tiff.II, Tiff.MM):
            return _tiff(file, head[:8], size)
        return _webp(head, size) if head[8:12] == b"WEBP" else None
    except DAMAGE:
        return None


def without_orientation(data: bytes) -> bytes:
    """A TIFF that no viewer turns: OpenCV follows its orientation whatever its flags say."""
    order, big = "<" if data.startswith(Tiff.II) else ">", 43 in data[2:4]  # 43: BigTIFF, for 4 GiB and more
    with suppress(struct.error):
        (directory,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
        (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, directory)
        first, size = (directory + 8, 20) if big else (directory + 2, 12)
        for at in range(first, min(first + count * size, len(data)), size):
            if struct.unpack_from(order + "H", data, at) == (ExifTags.Base.Orientation,):
                upright = bytearray(data)
                struct.pack_into(order + "H", upright, at + (12 if big else 8), 1)
                return bytes(upright)
    return data


def _tiff(file: BinaryIO, head: bytes, size: int) -> ImageInfo | None:
    """The size by a TIFF's first directory. Raises one of `DAMAGE`."""
    tags: Any = Tiff.ImageFileDirectory_v2(head)
    file.seek(tags.next)
    tags.load(file)
    places = (Tiff.TILEOFFSETS, Tiff.TILEBYTECOUNTS)
    if Tiff.TILEOFFSETS not in tags:
        places = (Tiff.STRIPOFFSETS, Tiff.STRIPBYTECOUNTS)
    offsets, counts = (tags[tag] for tag in places)
    bits, channels = set(tags[Tiff.BITSPERSAMPLE]), tags.get(Tiff.SAMPLESPERPIXEL, 1)
    usual = channels in _CHANNELS.get(tags[Tiff.PHOTOMETRIC_INTERPRETATION], ())
    whole_numbers = len(bits) == 1 and bits <= {8, 16} and set(tags.get(Tiff.SAMPLEFORMAT, (1,))) == {1}
    if not (usual and whole_numbers and max(map(sum, zip(offsets, counts, strict=True))) <= size):
        return None
    return ImageInfo(tags[Tiff.IMAGEWIDTH], tags[Tiff.IMAGELENGTH], bits.pop(), channels, channels == 4)


def _webp(head: bytes, size: int) -> ImageInfo | None:
    """By its container specification, developers.google.com/speed/webp/docs/riff_container."""
    if int.from_bytes(head[4:8], "little") + 8 > size:
        return None
    kind, alpha = head[12:16], False
    if kind == b"VP8X":
        width, height = (int.from_bytes(head[at : at + 3], "little") + 1 for at in (24, 27))
        alpha = bool(head[20] & 0x10)
    elif kind == b"VP8L":
        fields = int.from_bytes(head[21:25], "little")
        width, height = (fields & 0x3FFF) + 1, (fields >> 14 & 0x3FFF) + 1
        alpha = bool(fields >> 28 & 1)
    elif kind == b"VP8 ":
        width, height = (int.from_bytes(head[at : at + 2], "little") & 0x3FFF for at in (26, 28))
    else:
        return None
    return ImageInfo(width, height, 8, 4 if alpha else 3, alpha)
