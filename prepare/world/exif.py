"""Metadata of a panorama's file: GPS and time from EXIF, the attitude of the camera from XMP.

The attitude is that of Google's Photo Sphere XMP, as RICOH, Insta360, GoPro and others write it: namespace
http://ns.google.com/photos/1.0/panorama/, developers.google.com/streetview/spherical-metadata. Its angles are
those of an aircraft that faces the middle of the panorama, applied in the order heading, pitch, roll about
axes that turn along: heading clockwise from north, a positive pitch lifts the middle of the image above the
horizon, a positive roll lowers its right side.

All of this is optional: anything missing, damaged or impossible is left out.
"""

import io
import math
import struct
import warnings
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray
from PIL import ExifTags, Image

from panolog.prepare.world.image_blocks import Bounded, read_blocks
from panolog.scene.errors import SceneError

_GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
_XMP_TAG = 700  # of TIFF
_DAMAGE = (SyntaxError, ValueError, LookupError, TypeError, ArithmeticError, OSError, struct.error)


@dataclass(frozen=True)
class GpsFix:
    """The position of the camera by GPS, on WGS84."""

    latitude: float  # degrees north
    longitude: float  # degrees east
    altitude: float | None  # metres, above the sea or the ellipsoid: receivers differ


@dataclass(frozen=True)
class Attitude:
    """The attitude of the camera: GPano's angles in degrees. Missing angles are 0, as in viewers."""

    heading: float | None  # of the middle of the panorama, clockwise from north, [0, 360)
    pitch: float
    roll: float

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) the unit vector against gravity in camera axes: x right, y down, z forward."""
        pitch, roll = math.radians(self.pitch), math.radians(self.roll)
        return np.array(
            [-math.cos(pitch) * math.sin(roll), -math.cos(pitch) * math.cos(roll), math.sin(pitch)]
        )


@dataclass(frozen=True)
class Exif:
    """The metadata of an image file."""

    fix: GpsFix | None = None
    time: datetime | None = None  # of the camera's clock, without a zone: to sort by
    attitude: Attitude | None = None


def read_exif(path: Path) -> Exif:
    """The metadata of a JPEG, PNG or TIFF; any other file has none.

    Reads the parts that it needs, never a pixel. Pillow's warnings about damaged EXIF are suppressed by a
    filter that all threads share, so call this in one thread at a time.

    Raises:
        SceneError: there is no such file.
        OSError: it cannot be opened.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such image")
    with Bounded(io.FileIO(path)) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            exif, xmp = read_blocks(file)
        except OSError:
            return Exif()
        tags = _tags(exif)
        return Exif(_fix(tags), _time(tags), _attitude(xmp or _packet(tags)))


def _tags(exif: Bounded | None) -> Image.Exif:
    """The EXIF of a TIFF stream; empty if there is none or its first directory is damaged."""
    tags = Image.Exif()
    if exif is not None:
        try:
            tags.load_from_fp(exif)
        except _DAMAGE:
            return Image.Exif()
    return tags


def _packet(tags: Image.Exif) -> bytes | None:
    """The XMP of a TIFF."""
    try:
        return _bytes(tags.get(_XMP_TAG))
    except _DAMAGE:
        return None


def _fix(tags: Image.Exif) -> GpsFix | None:
    """The position in EXIF; zeros count as missing, because receivers without a fix write them."""
    try:
        gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _angle(gps[ExifTags.GPS.GPSLatitude], gps.get(ExifTags.GPS.GPSLatitudeRef), "NS")
        longitude = _angle(gps[ExifTags.GPS.GPSLongitude], gps.get(ExifTags.GPS.GPSLongitudeRef), "EW")
        if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
            return None
    except _DAMAGE:
        return None
    return GpsFix(latitude, longitude, _altitude(gps))


def _angle(parts: Any, reference: Any, names: str) -> float:
    """Degrees of degrees, minutes and seconds; `names` are the positive and the negative direction."""
    degrees, minutes, seconds = (float(part) for part in parts)
    direction = str(reference).strip("\0 ").upper()
    if direction not in tuple(names) or min(degrees, minutes, seconds) < 0:
        raise ValueError("no angle with a direction")
    angle = degrees + minutes / 60 + seconds / 3600
    return angle if direction == names[0] else -angle


def _altitude(gps: dict[int, Any]) -> float | None:
    try:
        altitude = float(gps[ExifTags.GPS.GPSAltitude])
    except _DAMAGE:
        return None
    reference = _bytes(gps.get(ExifTags.GPS.GPSAltitudeRef))
    below = reference is not None and reference[:1] in (b"\1", b"\3")  # 3: below the ellipsoid, EXIF 3.0
    return (-altitude if below else altitude) if abs(altitude) < 1e5 else None


def _time(tags: Image.Exif) -> datetime | None:
    """When the picture was taken, with fractions of a second; failing that, when the file was made."""
    try:
        details = tags.get_ifd(ExifTags.IFD.Exif)
        taken = details.get(ExifTags.Base.DateTimeOriginal)
        fraction = str(details.get(ExifTags.Base.SubsecTimeOriginal, "")).strip("\0 ") if taken else ""
        text = str(taken or tags.get(ExifTags.Base.DateTime, ""))[:19]
        time = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except _DAMAGE:
        return None
    digits = fraction[:6] if fraction.isascii() and fraction.isdigit() else "0"
    return time.replace(microsecond=int(digits.ljust(6, "0")))


def _attitude(xmp: bytes | None) -> Attitude | None:
    """GPano's pose angles, written as attributes or as elements."""
    if xmp is None:
        return None
    try:
        root: Element = fromstring(xmp.strip(b"\0 \t\r\n"), forbid_dtd=True)
    except _DAMAGE:
        return None
    heading = _degrees(root, "PoseHeadingDegrees", 0, 360)
    pitch = _degrees(root, "PosePitchDegrees", -90, 90)
    roll = _degrees(root, "PoseRollDegrees", -360, 360)  # the standard says 180; some count on to 360
    if heading is None and pitch is None and roll is None:
        return None
    return Attitude(None if heading is None else heading % 360, pitch or 0.0, roll or 0.0)


def _degrees(root: Element, name: str, least: float, most: float) -> float | None:
    """The first value of that name which is a number within its limits."""
    key = _GPANO + name
    for element in root.iter():
        text = element.get(key) or (element.text if element.tag == key else None)
        if text is not None and len(text) < 64:
            try:
                value = float(text)
            except ValueError:
                continue
            if least <= value <= most:
                return value
    return None


def _bytes(value: Any) -> bytes | None:
    """A tag's value, which Pillow gives as bytes or, a single one, as a number."""
    if isinstance(value, int):
        return bytes([value & 0xFF])
    return value if isinstance(value, bytes) else None
