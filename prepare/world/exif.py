"""Metadata of a panorama's file: GPS, time and exposure from EXIF, attitude and crop from XMP.

The attitude is that of Google's Photo Sphere XMP, as RICOH, Insta360, GoPro and others write it: namespace
http://ns.google.com/photos/1.0/panorama/, developers.google.com/streetview/spherical-metadata. Its angles are
those of an aircraft that faces the middle of the panorama, applied in the order heading, pitch, roll about
axes that turn along: heading clockwise from north, a positive pitch lifts the middle of the image above the
horizon, a positive roll lowers its right side. The crop is which pixels of the full panorama the image shows.

All of this is optional: anything missing, damaged or impossible is left out.
"""

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray
from PIL import ExifTags, Image

from panolog.prepare.world.image_blocks import EXIF_HEAD, Bounded, read_blocks
from panolog.scene.errors import SceneError
from panolog.scene.pictures.headers import DAMAGE

_GPANO = "{http://ns.google.com/photos/1.0/panorama/}"
_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
    ' GPano:ProjectionType="equirectangular"{}/></rdf:RDF></x:xmpmeta>'
)
_XMP_TAG = 700  # of TIFF
_SPEEDS = (
    ExifTags.Base.ISOSpeedRatings,
    ExifTags.Base.ISOSpeed,
    ExifTags.Base.RecommendedExposureIndex,
    ExifTags.Base.StandardOutputSensitivity,
)
_DETAILS = (
    ExifTags.Base.DateTimeOriginal,
    ExifTags.Base.SubsecTimeOriginal,
    ExifTags.Base.ExposureTime,
    ExifTags.Base.ShutterSpeedValue,
    ExifTags.Base.FNumber,
    ExifTags.Base.ApertureValue,
    *_SPEEDS,
)
_GPS = (
    ExifTags.GPS.GPSLatitude,
    ExifTags.GPS.GPSLatitudeRef,
    ExifTags.GPS.GPSLongitude,
    ExifTags.GPS.GPSLongitudeRef,
    ExifTags.GPS.GPSAltitude,
    ExifTags.GPS.GPSAltitudeRef,
)


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

    @property
    def packet(self) -> bytes:
        """The XMP with GPano's angles, from which the same attitude is read."""
        angles = {"Heading": self.heading, "Pitch": self.pitch, "Roll": self.roll}
        known = {name: float(angle) for name, angle in angles.items() if angle is not None}
        return _XMP.format("".join(f' GPano:Pose{k}Degrees="{v!r}"' for k, v in known.items())).encode()


@dataclass(frozen=True)
class Crop:
    """Which pixels of a full panorama a picture shows, by GPano; the picture may have been scaled since."""

    full: tuple[int, int]  # width and height of the full panorama
    left: int  # column and row of the picture's first pixel in it
    top: int
    size: tuple[int, int]  # width and height of the picture

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing."""
        return self.size == self.full


@dataclass(frozen=True)
class Exif:
    """The metadata of an image file."""

    fix: GpsFix | None = None
    time: datetime | None = None  # of the camera's clock, without a zone: to sort by
    attitude: Attitude | None = None
    exposure_stops: float | None = (
        None  # log2 of time (s) · ISO / 100 / f-number²: one more is twice as bright
    )
    orientation: int = 1  # how viewers turn the picture, 1 to 8 as EXIF counts; 1 = as it is stored
    crop: Crop | None = None


def read_exif(path: Path) -> Exif:
    """The metadata of a JPEG, PNG, WebP or TIFF; any other file has none.

    The f-number of a lens that cannot change is often missing; it then counts as 1. The exposure bias is no
    part of the exposure: the camera has realised it in the time or the ISO.

    Reads the parts that it needs, never a pixel. Pillow's warnings about damaged EXIF are suppressed by a
    filter that all threads share, so call this in one thread at a time.

    Raises SceneError: there is no such file; OSError: it cannot be opened.
    """
    if not path.is_file():
        raise SceneError(f"{path}: there is no such image")
    with _opened(path) as file:
        try:
            exif, xmp = read_blocks(file)
        except OSError:
            return Exif()
        tags = _tags(exif)
        root = _parsed(xmp or _packet(tags))
        return Exif(
            _fix(tags),
            _time(tags),
            None if root is None else _attitude(root),
            _exposure(tags),
            _orientation(tags),
            None if root is None else _crop(root),
        )


def essential_exif(path: Path) -> bytes | None:
    """The EXIF of an image file as a new TIFF stream, reduced to what `read_exif` reads: no orientation.

    None if there is none, or it is damaged. Raises as `read_exif` does.
    """
    with _opened(path) as file:
        try:
            tags, reduced = _tags(read_blocks(file)[0]), Image.Exif()
            details, gps = tags.get_ifd(ExifTags.IFD.Exif), tags.get_ifd(ExifTags.IFD.GPSInfo)
            if kept := {tag: details[tag] for tag in _DETAILS if tag in details}:
                reduced[ExifTags.IFD.Exif] = kept
            if place := {tag: gps[tag] for tag in _GPS if tag in gps}:
                reduced[ExifTags.IFD.GPSInfo] = place
            if ExifTags.Base.DateTime in tags:
                reduced[ExifTags.Base.DateTime] = tags[ExifTags.Base.DateTime]
            return reduced.tobytes().removeprefix(EXIF_HEAD) if len(reduced) else None
        except DAMAGE:
            return None


def camera_of(path: Path) -> str:
    """Make, model and serial number of the camera by EXIF; empty without. Raises as `read_exif` does."""
    with _opened(path) as file:
        try:
            tags = _tags(read_blocks(file)[0])
            serial = tags.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.BodySerialNumber)
            parts = (tags.get(ExifTags.Base.Make), tags.get(ExifTags.Base.Model), serial)
        except DAMAGE:
            return ""
    return " ".join(text for it in parts if (text := str(it or "").strip("\0 ")[:80]))


@contextmanager
def _opened(path: Path) -> Iterator[Bounded]:
    """An image file, within which Pillow does not warn of damage."""
    with Bounded(io.FileIO(path)) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield file


def _tags(exif: Bounded | None) -> Image.Exif:
    """The EXIF of a TIFF stream; empty if there is none or its first directory is damaged."""
    tags = Image.Exif()
    if exif is not None:
        try:
            tags.load_from_fp(exif)
        except DAMAGE:
            return Image.Exif()
    return tags


def _packet(tags: Image.Exif) -> bytes | None:
    """The XMP of a TIFF."""
    try:
        return _bytes(tags.get(_XMP_TAG))
    except DAMAGE:
        return None


def _fix(tags: Image.Exif) -> GpsFix | None:
    """The position in EXIF; zeros count as missing, because receivers without a fix write them."""
    try:
        gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _angle(gps[ExifTags.GPS.GPSLatitude], gps.get(ExifTags.GPS.GPSLatitudeRef), "NS")
        longitude = _angle(gps[ExifTags.GPS.GPSLongitude], gps.get(ExifTags.GPS.GPSLongitudeRef), "EW")
        if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
            return None
    except DAMAGE:
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
    except DAMAGE:
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
    except DAMAGE:
        return None
    digits = fraction[:6] if fraction.isascii() and fraction.isdigit() else "0"
    return time.replace(microsecond=int(digits.ljust(6, "0")))


def _exposure(tags: Image.Exif) -> float | None:
    """The exposure in stops, from the fields themselves or from their APEX values."""
    try:
        details = tags.get_ifd(ExifTags.IFD.Exif)
    except DAMAGE:
        return None
    base = ExifTags.Base
    time = _within(details.get(base.ExposureTime), 1e-7, 1e4)
    if time is None and (speed := _within(details.get(base.ShutterSpeedValue), -13, 23)) is not None:
        time = 2.0**-speed
    aperture = _within(details.get(base.FNumber), 0.3, 200)
    if aperture is None and (value := _within(details.get(base.ApertureValue), -3, 15)) is not None:
        aperture = 2.0 ** (value / 2)
    # 65,535 in the first of these means: more than it can hold, see the others.
    speeds = (_within(details.get(tag), 1, 1e7) for tag in _SPEEDS)
    sensitivity = next((speed for speed in speeds if speed is not None and speed != 65_535), None)
    if time is None or sensitivity is None:
        return None
    return math.log2(time * sensitivity / 100 / (aperture or 1.0) ** 2)


def _within(value: Any, least: float, most: float) -> float | None:
    """A number of EXIF, the first where there are several; None if it is none between the limits."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except DAMAGE:
        return None
    return number if least <= number <= most else None


def _orientation(tags: Image.Exif) -> int:
    try:
        value = tags.get(ExifTags.Base.Orientation)
    except DAMAGE:
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _parsed(xmp: bytes | None) -> Element | None:
    """The root of an XMP packet."""
    if xmp is None:
        return None
    try:
        root: Element = fromstring(xmp.strip(b"\0 \t\r\n"), forbid_dtd=True)
    except DAMAGE:
        return None
    return root


def _crop(root: Element) -> Crop | None:
    """GPano's crop, if all of it is there and lies within the full panorama."""
    names = (
        "FullPanoWidthPixels",
        "FullPanoHeightPixels",
        "CroppedAreaLeftPixels",
        "CroppedAreaTopPixels",
        "CroppedAreaImageWidthPixels",
        "CroppedAreaImageHeightPixels",
    )
    found = [_number(root, name, 0, 2**20) for name in names]
    values = [int(value) for value in found if value is not None and value == int(value)]
    if len(values) < len(names):
        return None
    full_width, full_height, left, top, width, height = values
    if not (0 < width <= full_width - left and 0 < height <= full_height - top):
        return None
    return Crop((full_width, full_height), left, top, (width, height))


def _attitude(root: Element) -> Attitude | None:
    """GPano's pose angles, written as attributes or as elements."""
    heading = _number(root, "PoseHeadingDegrees", 0, 360)
    pitch = _number(root, "PosePitchDegrees", -90, 90)
    roll = _number(root, "PoseRollDegrees", -360, 360)  # the standard says 180; some count on to 360
    if heading is None and pitch is None and roll is None:
        return None
    return Attitude(None if heading is None else heading % 360, pitch or 0.0, roll or 0.0)


def _number(root: Element, name: str, least: float, most: float) -> float | None:
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
