"""Writes what a video knows of a frame into its JPEG, as cameras for stills do, for `read_exif`."""

from datetime import datetime
from fractions import Fraction

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from panolog.prepare.world.exif import Attitude, GpsFix
from panolog.prepare.world.image_blocks import EXIF_HEAD, with_metadata

_SECOND = 1_000_000  # parts of a second; of a second of arc, one is 30 micrometres on the ground
_LARGEST = 65_534  # ISO that fits; one more means that it does not


def stamped(
    jpeg: bytes,
    *,
    fix: GpsFix | None = None,
    attitude: Attitude | None = None,
    taken: datetime | None = None,
    exposure: tuple[float, float] | None = None,
) -> bytes:
    """The JPEG with EXIF (position, time, exposure) and XMP (GPano's attitude), of what is not None.

    Args:
        jpeg: as OpenCV writes it, with a JFIF segment at its beginning.
        taken: when it was taken, in UTC.
        exposure: seconds and ISO.
    """
    known = fix is not None or taken is not None or exposure is not None
    exif = _exif(fix, taken, exposure) if known else None
    return with_metadata(jpeg, exif, None if attitude is None else attitude.packet)


def _exif(fix: GpsFix | None, taken: datetime | None, exposure: tuple[float, float] | None) -> bytes:
    exif = Image.Exif()
    details = exif.get_ifd(ExifTags.IFD.Exif)
    if exposure is not None:
        details[ExifTags.Base.ExposureTime] = IFDRational(round(exposure[0] * _SECOND), _SECOND)
        details[ExifTags.Base.ISOSpeedRatings] = min(round(exposure[1]), _LARGEST)
    if taken is not None:
        details[ExifTags.Base.DateTimeOriginal] = taken.strftime("%Y:%m:%d %H:%M:%S")
        details[ExifTags.Base.SubsecTimeOriginal] = f"{taken.microsecond:06d}"
        details[ExifTags.Base.OffsetTimeOriginal] = "+00:00"
    if fix is not None:
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps[ExifTags.GPS.GPSLatitudeRef] = "N" if fix.latitude >= 0 else "S"
        gps[ExifTags.GPS.GPSLatitude] = _parts(fix.latitude)
        gps[ExifTags.GPS.GPSLongitudeRef] = "E" if fix.longitude >= 0 else "W"
        gps[ExifTags.GPS.GPSLongitude] = _parts(fix.longitude)
        if fix.altitude is not None:
            gps[ExifTags.GPS.GPSAltitudeRef] = b"\0" if fix.altitude >= 0 else b"\1"
            gps[ExifTags.GPS.GPSAltitude] = Fraction(round(abs(fix.altitude) * 1000), 1000)
    return exif.tobytes().removeprefix(EXIF_HEAD)


def _parts(angle: float) -> tuple[Fraction, Fraction, Fraction]:
    """Degrees, minutes and seconds of an angle in degrees, without its sign."""
    minutes, seconds = divmod(round(abs(angle) * 3600 * _SECOND), 60 * _SECOND)
    degrees, minutes = divmod(minutes, 60)
    return Fraction(degrees), Fraction(minutes), Fraction(seconds, _SECOND)
