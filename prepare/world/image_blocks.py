"""The EXIF and XMP of image files as bytes, read with a bound for any content of a file, and written."""

import io
import struct
import zlib
from collections.abc import Iterator

from panolog.scene.pictures.profiles import JPEG, PNG, chunks, is_webp, jpeg_segments

_TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_APP1 = 0xE1
EXIF_HEAD, XMP_HEAD = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"  # of segments of a JPEG
_PNG_HEADER = 33  # bytes of a PNG before its second chunk: the signature and IHDR
_PNG_XMP = b"XML:com.adobe.xmp\0"
_PARTS = (b"eXIf", b"iTXt", b"EXIF", b"XMP ")  # chunks of a PNG and of a WebP
_BLOCK = 2**20  # bytes of a PNG's EXIF or XMP; a JPEG's have 65,533 at most
_READ = 2**22  # bytes that are read in all: the entries of EXIF may all point at the same large block


class Bounded(io.BufferedReader):
    """A stream of which no more than `_READ` bytes can be read, in all."""

    _left = _READ

    def read(self, size: int | None = -1, /) -> bytes:
        """Reads as any stream; raises OSError above the limit."""
        self._left -= _READ + 1 if size is None or size < 0 else size
        if self._left < 0:
            raise OSError("the file holds more than any camera writes")
        return super().read(size)


def read_blocks(file: Bounded) -> tuple[Bounded | None, bytes | None]:
    """The EXIF of a JPEG, PNG, WebP or TIFF as a TIFF stream, and its XMP packet: of a TIFF, that is tag 700.

    Raises OSError if there is more of it than any camera writes.
    """
    magic = file.read(12)
    if magic[:4] in _TIFFS:
        file.seek(0)
        return file, None
    exif = xmp = None
    for part in _parts(file, magic):
        if part.startswith(EXIF_HEAD) and exif is None:
            exif = Bounded(io.BytesIO(part[len(EXIF_HEAD) :]))
        elif part.startswith(XMP_HEAD) and xmp is None:
            xmp = part[len(XMP_HEAD) :]
        if exif is not None and xmp is not None:
            break
    return exif, xmp


def _parts(file: Bounded, magic: bytes) -> Iterator[bytes]:
    """The EXIF and XMP of a file that begins with `magic`, with the heads that a JPEG gives them."""
    if magic[:2] == JPEG:
        return _jpeg_parts(file)
    png = magic[:8] == PNG
    file.seek(8 if png else 12)
    return _chunk_parts(file, png) if png or is_webp(magic) else iter(())


def _jpeg_parts(file: Bounded) -> Iterator[bytes]:
    """The contents of the APP1 segments with EXIF or XMP before the first scan."""
    for marker, length in jpeg_segments(file):
        head = file.read(min(length, len(XMP_HEAD))) if marker == _APP1 else b""
        if head.startswith((EXIF_HEAD, XMP_HEAD)):
            yield head + file.read(length - len(head))


def _chunk_parts(file: Bounded, png: bool) -> Iterator[bytes]:
    """The EXIF and XMP of a PNG or WebP, before or after the pixels; the file is at its first chunk."""
    for kind, length in chunks(file, png=png):
        data = file.read(length) if kind in _PARTS and length <= _BLOCK else b""
        if data and kind in (b"eXIf", b"EXIF"):
            yield EXIF_HEAD + data.removeprefix(EXIF_HEAD)
        elif data and kind == b"XMP ":
            yield XMP_HEAD + data
        elif data.startswith(_PNG_XMP):
            yield XMP_HEAD + _text(data[len(_PNG_XMP) :])


def _text(data: bytes) -> bytes:
    """The text of an iTXt chunk after its keyword: two flags, language, translated keyword, text.

    Empty if it is damaged.
    """
    try:
        _, _, text = data[2:].split(b"\0", 2)
        return zlib.decompressobj().decompress(text, _BLOCK) if data[0] else text
    except (ValueError, zlib.error):
        return b""


def with_chunks(png: bytes, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG with these chunks, each a kind of four characters and its data, before the others but IHDR."""
    packed = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return png[:_PNG_HEADER] + packed + png[_PNG_HEADER:]


def with_metadata(image: bytes, exif: bytes | None, xmp: bytes | None) -> bytes:
    """A PNG or JPEG, as OpenCV writes it, with EXIF (a TIFF stream) and an XMP packet, if there are any."""
    if image.startswith(PNG):
        chunks = [] if exif is None else [(b"eXIf", exif)]
        chunks += [] if xmp is None else [(b"iTXt", _PNG_XMP + b"\0\0\0\0" + xmp)]
        return with_chunks(image, *chunks)
    behind = 4 + int.from_bytes(image[4:6], "big")  # a JFIF segment, which has to stay the first
    segments = [] if exif is None else [EXIF_HEAD + exif]
    segments += [] if xmp is None else [XMP_HEAD + xmp]
    marked = (bytes((0xFF, _APP1)) + (len(it) + 2).to_bytes(2, "big") + it for it in segments)
    return image[:behind] + b"".join(marked) + image[behind:]
