"""Stills as cameras and stitchers write them: EXIF and XMP in every format, by Pillow or by exiftool."""

from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import IFDRational

BASE, GPS = ExifTags.Base, ExifTags.GPS
SUFFIXES = (".jpg", ".png", ".tif", ".webp")
_HEAD = '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">'
_RDF = '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
_TAIL = "</rdf:RDF></x:xmpmeta>" + " " * 2000 + '<?xpacket end="w"?>'
CAMERA: dict[int, object] = {
    BASE.DateTimeOriginal: "2024:05:31 12:34:56",
    BASE.SubsecTimeOriginal: "25",
    BASE.ExposureTime: Fraction(1, 250),
    BASE.FNumber: Fraction(21, 10),
    BASE.ISOSpeedRatings: 200,
    BASE.ExposureBiasValue: Fraction(-7, 10),
    BASE.MakerNote: b"\x01" * 500,
}
PLACE: dict[int, object] = {
    GPS.GPSLatitudeRef: "N",
    GPS.GPSLatitude: (47, 22, Fraction(3912, 100)),
    GPS.GPSLongitudeRef: "E",
    GPS.GPSLongitude: (8, Fraction(325, 10), 0),
    GPS.GPSAltitudeRef: b"\0",
    GPS.GPSAltitude: Fraction(4085, 10),
}


def gpano(values: Mapping[str, float | str], *, elements: bool = False) -> bytes:
    """An XMP packet with values of GPano by name, as attributes or as elements."""
    if elements:
        inside = "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in values.items())
        content = f">{inside}</rdf:Description>"
    else:
        content = "".join(f' GPano:{name}="{value}"' for name, value in values.items()) + "/>"
    return f'{_HEAD}{_RDF} xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"{content}{_TAIL}'.encode()


def crop(full: tuple[int, int], left: int, top: int, size: tuple[int, int]) -> dict[str, float | str]:
    """GPano's description of a cropped panorama."""
    return {
        "FullPanoWidthPixels": full[0],
        "FullPanoHeightPixels": full[1],
        "CroppedAreaLeftPixels": left,
        "CroppedAreaTopPixels": top,
        "CroppedAreaImageWidthPixels": size[0],
        "CroppedAreaImageHeightPixels": size[1],
    }


def write_still(
    path: Path,
    pixels: NDArray[np.uint8],
    *,
    camera: Mapping[int, object] = CAMERA,
    place: Mapping[int, object] | None = PLACE,
    panorama: Mapping[str, float | str] | bytes | None = None,
    orientation: int | None = None,
    changed: str | None = "2025:01:01 00:00:00",
) -> Path:
    """Writes (H, W, 3 or 4) RGB in the format of the suffix, lossless where that can be.

    Args: camera, place, tags of EXIF; panorama, values of GPano or an XMP packet; changed, the file's time.
    """
    tags = Image.Exif()
    tags[BASE.Make] = "RICOH"
    if changed is not None:
        tags[BASE.DateTime] = changed
    tags[ExifTags.IFD.Exif] = {
        tag: IFDRational(value) if isinstance(value, Fraction) else value for tag, value in camera.items()
    }
    if place is not None:
        tags[ExifTags.IFD.GPSInfo] = dict(place)
    if orientation is not None:
        tags[BASE.Orientation] = orientation
    xmp = gpano(panorama) if isinstance(panorama, Mapping) else panorama
    more: dict[str, Any] = {"xmp": xmp} if xmp else {}
    image = Image.fromarray(pixels)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        info = PngInfo()
        if xmp is not None:
            info.add_itxt("XML:com.adobe.xmp", xmp.decode(), zip=True)
        image.save(path, exif=tags, pnginfo=info)
    elif path.suffix == ".tif":
        whole = Image.Exif()
        whole.load(tags.tobytes())  # with its directories in one block, from which the TIFF's are copied
        if xmp is not None:
            whole[700] = xmp
        image.save(path, exif=whole)
    elif path.suffix == ".webp":
        image.save(path, exif=tags, lossless=True, exact=True, **more)
    else:
        image.save(path, exif=tags, quality=100, subsampling=0, **more)
    return path
