"""HEIC and AVIF panoramas become PNG: what follows reads, and other programs open, files of few formats.

Pillow decodes AVIF, and HEIC with pi-heif, the decoder of pillow-heif without its encoder, whose x265 is
under the GPL. Pixels are turned as the file says, colours are converted to sRGB, and EXIF and XMP are kept.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageOps
from PIL.PngImagePlugin import PngInfo

from panolog.prepare.file_kinds import AVIF, HEIC
from panolog.prepare.panorama_files import PanoramaFile, remade
from panolog.prepare.provenance import MAX_BYTES
from panolog.scene.errors import ImageError, SceneError, require
from panolog.scene.pictures.headers import DAMAGE
from panolog.scene.pictures.profiles import in_srgb
from panolog.scene.write import Progress, no_progress

_DAMAGE = (*DAMAGE, RuntimeError)  # which libheif raises as well
_HEAD = 2**20  # bytes in which a file says what its colours are
_PLAIN = (1, 2, 5, 6)  # primaries of BT.709, unknown, of BT.601: what sRGB is close to
_HDR = (16, 18)  # transfer functions PQ and HLG


def as_png(
    panoramas: Sequence[PanoramaFile], folder: Path, progress: Progress = no_progress
) -> tuple[PanoramaFile, ...]:
    """The panoramas, of which those in HEIC and AVIF are PNG files in `folder`.

    What an earlier call has converted is not done again.

    Raises SceneError: a picture is damaged, in HDR or larger than any panorama; MissingPackageError: what
    decodes it is missing; OSError: a file cannot be read or written.
    """
    heic = {row: ".png" for row, panorama in enumerate(panoramas) if is_converted(panorama.path)}
    return remade(panoramas, heic, folder, lambda row, path: _convert(panoramas[row].path, path), progress)


def is_converted(path: Path) -> bool:
    """Whether a file is to be converted, by its name."""
    return path.suffix.lower() in (*AVIF, *HEIC)


def displayed_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels of what `as_png` makes of a file, by its header. Raises as `as_png`."""
    with _open(path) as picture:
        turned = picture.getexif().get(0x0112, 1) >= 5  # by a quarter
        return (picture.height, picture.width) if turned else picture.size


def _open(path: Path) -> Image.Image:
    """A picture whose pixels are not decoded yet. Raises as `as_png`."""
    if path.suffix.lower() in HEIC:
        require("pi_heif")
        from pi_heif import register_heif_opener  # noqa: PLC0415  # AVIF does not need it

        register_heif_opener()
    try:
        picture = Image.open(path)
    except (*_DAMAGE, Image.DecompressionBombError) as error:
        raise _damaged(path, error) from error
    if picture.width * picture.height * 4 > MAX_BYTES:
        raise SceneError(f"{path}: {picture.width} x {picture.height} pixels, more than any panorama has")
    return picture


def _convert(path: Path, output: Path) -> None:
    """Writes a picture as PNG."""
    with _open(path) as picture:
        _check_colors(path, picture)
        try:
            upright = ImageOps.exif_transpose(picture)
            pixels = in_srgb(upright)
        except _DAMAGE as error:
            raise _damaged(path, error) from error
        if upright.has_transparency_data:
            pixels.putalpha(upright.convert("RGBA").getchannel("A"))
        texts = PngInfo()
        if isinstance(xmp := upright.info.get("xmp"), bytes):
            texts.add_itxt("XML:com.adobe.xmp", xmp.decode(errors="replace"))
        exif = upright.info.get("exif") or b""
        pixels.save(output, "PNG", exif=exif, pnginfo=texts, icc_profile=None, compress_level=1)


def _check_colors(path: Path, picture: Image.Image) -> None:
    """Raises SceneError where numbers (CICP, in a box `colr` of kind `nclx`) say other colours than sRGB."""
    with path.open("rb") as file:
        found = file.read(_HEAD).partition(b"colrnclx")[2][:4]
    primaries, transfer = struct.unpack(">HH", found) if len(found) == 4 else (1, 1)
    if transfer in _HDR:
        raise SceneError(f"{path}: is in HDR (PQ or HLG); export it in SDR")
    if primaries not in _PLAIN and "icc_profile" not in picture.info:
        raise SceneError(f"{path}: has a wide gamut without a colour profile; export it in sRGB")


def _damaged(path: Path, error: BaseException) -> ImageError:
    return ImageError(f"{path}: cannot be decoded ({error}); the picture is damaged, or of another format")
