"""What image files say of themselves, in all the ways that cameras write it, and damaged."""

import math
import struct
import zlib
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from panolog.prepare.world.exif import Attitude, Crop, Exif, GpsFix, read_exif
from panolog.scene.errors import InputError
from tests.data import mutated
from tests.prepare.world.stills import BASE, CAMERA, GPS, PLACE, SUFFIXES, crop, gpano, write_still

FIX = GpsFix(47 + 22 / 60 + 39.12 / 3600, 8 + 32.5 / 60, 408.5)
TAKEN = datetime(2024, 5, 31, 12, 34, 56, 250_000)
STOPS = math.log2(1 / 250 * 200 / 100 / 2.1**2)
POSE: dict[str, float | str] = {"PoseHeadingDegrees": 225.5, "PosePitchDegrees": 17, "PoseRollDegrees": -121}
ATTITUDE = Attitude(225.5, 17, -121)
SIZE = (16, 8)
CROP = crop((32, 16), 4, 2, SIZE)
BLACK = np.zeros((8, 16, 3), np.uint8)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("elements", [False, True])
def test_all_that_a_camera_writes(tmp_path: Path, suffix: str, elements: bool) -> None:
    xmp = gpano({**POSE, **CROP}, elements=elements)
    found = read_exif(write_still(tmp_path / f"a{suffix}", BLACK, panorama=xmp, orientation=6))
    assert found.fix is not None
    assert (found.fix.latitude, found.fix.longitude) == pytest.approx((FIX.latitude, FIX.longitude), abs=1e-9)
    assert found.fix.altitude == 408.5
    assert found.time == TAKEN
    assert found.attitude == ATTITUDE
    assert found.exposure_stops == pytest.approx(STOPS)
    assert found.crop == Crop((32, 16), 4, 2, SIZE)
    assert found.orientation == 6


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_that_say_nothing(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    Image.new("RGB", (16, 8)).save(path)
    assert read_exif(path) == Exif()
    path.write_bytes(b"")
    assert read_exif(path) == Exif()


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.jpg: there is no such image"):
        read_exif(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({GPS.GPSLatitudeRef: "S", GPS.GPSLongitudeRef: "W"}, GpsFix(-FIX.latitude, -FIX.longitude, 408.5)),
        ({GPS.GPSAltitudeRef: b"\1"}, GpsFix(FIX.latitude, FIX.longitude, -408.5)),
        ({GPS.GPSAltitude: Fraction(10**8)}, GpsFix(FIX.latitude, FIX.longitude, None)),
        ({GPS.GPSLatitude: (0, 0, 0), GPS.GPSLongitude: (0, 0, 0)}, None),
        ({GPS.GPSLatitude: (90, 30, 0)}, None),
        ({GPS.GPSLongitude: (181, 0, 0)}, None),
        ({GPS.GPSLatitudeRef: ""}, None),
        ({GPS.GPSLatitude: (1, 2)}, None),
    ],
)
def test_places(tmp_path: Path, change: dict[int, object], wanted: GpsFix | None) -> None:
    found = read_exif(write_still(tmp_path / "a.jpg", BLACK, place={**PLACE, **change})).fix
    if wanted is None:
        assert found is None
    else:
        assert found is not None
        assert (found.latitude, found.longitude) == pytest.approx((wanted.latitude, wanted.longitude))
        assert found.altitude == wanted.altitude


def test_numbers_without_denominator(tmp_path: Path) -> None:
    """Receivers without a place write 0/0."""
    place = {**PLACE, GPS.GPSLatitude: (47, 22, Fraction(391_234, 10_000))}
    path = write_still(tmp_path / "a.jpg", BLACK, place=place)
    data = path.read_bytes()
    assert struct.pack(">II", 195_617, 5_000) in data
    path.write_bytes(data.replace(struct.pack(">II", 195_617, 5_000), bytes(8)))
    assert read_exif(path).fix is None


def test_time_of_the_file_where_the_camera_wrote_none(tmp_path: Path) -> None:
    for changed, wanted in (
        (None, None),
        ("0000:00:00 00:00:00", None),
        ("2025:01:02 03:04:05", datetime(2025, 1, 2, 3, 4, 5)),
    ):
        path = write_still(tmp_path / "a.jpg", BLACK, camera={}, changed=changed)
        assert read_exif(path).time == wanted


@pytest.mark.parametrize(
    ("written", "wanted"),
    [
        ({"PosePitchDegrees": "-5"}, Attitude(None, -5, 0)),
        ({"PoseHeadingDegrees": "360"}, Attitude(0, 0, 0)),
        ({"PosePitchDegrees": "91", "PoseRollDegrees": "2"}, Attitude(None, 0, 2)),
        ({"PosePitchDegrees": "nan", "PoseRollDegrees": "inf"}, None),
        ({"PosePitchDegrees": "five"}, None),
        ({"PosePitchDegrees": "1" * 1000}, None),
        ({"ProjectionType": "equirectangular"}, None),
    ],
)
def test_attitudes(tmp_path: Path, written: dict[str, str], wanted: Attitude | None) -> None:
    assert read_exif(write_still(tmp_path / "a.jpg", BLACK, panorama=written)).attitude == wanted


def test_up_is_what_the_standard_says() -> None:
    """World axes east, north, up; the sphere's x right, y forward, z up; heading clockwise."""
    random = np.random.default_rng(0)
    for heading, pitch, roll in random.uniform((0, -90, -180), (360, 90, 180), (20, 3)):
        world_from_sphere = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
        right, forward, up = world_from_sphere[2]  # how far each of the sphere's axes points up
        wanted = np.array([right, -up, forward])
        assert np.abs(Attitude(heading, pitch, roll).up - wanted).max() < 1e-12
    assert Attitude(None, 30, 0).up[2] > 0.4  # the middle of the image is lifted
    assert Attitude(None, 0, 30).up[0] < -0.4  # its right side is lowered


def test_metadata_behind_the_pixels_of_a_png(tmp_path: Path) -> None:
    """Where ExifTool puts it."""
    path, exif = tmp_path / "a.png", Image.open(write_still(tmp_path / "a.jpg", BLACK)).info["exif"][6:]
    Image.new("RGB", SIZE).save(path)
    data, end = path.read_bytes()[:-12], path.read_bytes()[-12:]
    for kind, content in ((b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + gpano(POSE)), (b"eXIf", exif)):
        part = kind + content
        data += struct.pack(">I", len(content)) + part + struct.pack(">I", zlib.crc32(part))
    path.write_bytes(data + end)
    found = read_exif(path)
    assert found.attitude == ATTITUDE
    assert found.fix is not None


def packed_bomb() -> bytes:
    """A PNG whose XMP unfolds a thousandfold."""
    content = b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(bytes(2**25))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4s", len(content), b"iTXt") + content + bytes(4)


def overlapping() -> bytes:
    """EXIF with 5,000 entries that all point at the same 60 kB."""
    entries = [struct.pack(">HHII", tag, 7, 60_000, 8) for tag in range(5_000)]
    block = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", len(entries)) + b"".join(entries)
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(block) + 2) + block + b"\xff\xd9"


def entities() -> bytes:
    """XMP that doubles an entity again and again."""
    lines = b"".join(b'<!ENTITY a%d "&a%d;&a%d;">' % (n, n - 1, n - 1) for n in range(1, 40))
    packet = b'<!DOCTYPE x [<!ENTITY a0 "x">' + lines + b"]><x>&a39;</x>"
    segment = b"http://ns.adobe.com/xap/1.0/\0" + packet
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + b"\xff\xd9"


@pytest.mark.parametrize(
    "hostile",
    [
        packed_bomb,
        overlapping,
        entities,
        lambda: b"\xff\xd8" + b"\xff" * 2**20,
        lambda: b"\xff\xd8" + b"\xff\xe1\0\2" * 2**18,
        lambda: b"II+\0\x08\0\0\0\x10" + bytes(7) + b"\xff" * 2**16,
        lambda: b"II*\0\x08\0\0\0" + b"\xff" * 2**16,
        lambda: b"\x89PNG\r\n\x1a\n" + b"\xff\xff\xff\xffeXIf" + bytes(100),
    ],
)
def test_hostile_files_say_nothing(tmp_path: Path, hostile: Callable[[], bytes]) -> None:
    path = tmp_path / "a"
    path.write_bytes(hostile())
    assert read_exif(path) == Exif()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_mutations_never_raise(tmp_path: Path, suffix: str) -> None:
    """Bytes changed, cut and repeated: what comes out is nothing or plausible."""
    whole = write_still(tmp_path / f"whole{suffix}", BLACK, panorama=POSE).read_bytes()
    random = np.random.default_rng(0)
    path = tmp_path / "mutated"
    for _ in range(200):
        path.write_bytes(mutated(mutated(whole, random) or whole, random))
        found = read_exif(path)
        if found.fix is not None:
            assert abs(found.fix.latitude) <= 90
            assert abs(found.fix.longitude) <= 180
        if found.attitude is not None:
            assert np.isfinite(found.attitude.up).all()


def test_a_damaged_part_leaves_the_other(tmp_path: Path) -> None:
    path = write_still(tmp_path / "a.jpg", BLACK, panorama=POSE)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"<rdf:RDF", b"<rdf;RDF"))
    assert (read_exif(path).attitude, read_exif(path).time) == (None, TAKEN)
    path.write_bytes(data.replace(b"Exif\0\0MM\0*", b"Exif\0\0MM\0\0"))
    assert (read_exif(path).attitude, read_exif(path).time) == (ATTITUDE, None)


def test_pixels_are_not_read(tmp_path: Path) -> None:
    """A file that ends within its pixels still says what it says."""
    noise = np.random.default_rng(0).integers(0, 256, (128, 256, 3), np.uint8)
    path = write_still(tmp_path / "a.jpg", noise)
    path.write_bytes(path.read_bytes()[:2000])
    assert read_exif(path).time == TAKEN


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({}, STOPS),
        ({BASE.ExposureTime: Fraction(1, 125)}, STOPS + 1),
        ({BASE.ISOSpeedRatings: 400}, STOPS + 1),
        ({BASE.ISOSpeedRatings: (400, 100)}, STOPS + 1),
        ({BASE.FNumber: Fraction(42, 10)}, STOPS - 2),
        ({BASE.FNumber: None}, STOPS + 2 * math.log2(2.1)),
        ({BASE.FNumber: None, BASE.ApertureValue: Fraction(2)}, STOPS + 2 * math.log2(2.1) - 2),
        ({BASE.ExposureTime: None, BASE.ShutterSpeedValue: Fraction(10)}, STOPS + math.log2(250) - 10),
        ({BASE.ISOSpeedRatings: 65_535, BASE.RecommendedExposureIndex: 102_400}, STOPS + 9),
        ({BASE.ExposureBiasValue: Fraction(2)}, STOPS),
        ({BASE.ExposureTime: None}, None),
        ({BASE.ISOSpeedRatings: None}, None),
        ({BASE.ISOSpeedRatings: 0}, None),
        ({BASE.ISOSpeedRatings: "many"}, None),
        ({BASE.ExposureTime: Fraction(0)}, None),
        ({BASE.ExposureTime: Fraction(10**9)}, None),
    ],
)
def test_exposure_in_stops(tmp_path: Path, changes: dict[int, object], wanted: float | None) -> None:
    camera = {tag: value for tag, value in {**CAMERA, **changes}.items() if value is not None}
    found = read_exif(write_still(tmp_path / "a.jpg", BLACK, camera=camera)).exposure_stops
    assert found == (None if wanted is None else pytest.approx(wanted))


@pytest.mark.parametrize(
    "changes",
    [
        {"FullPanoWidthPixels": -32},
        {"CroppedAreaImageWidthPixels": 32},  # beyond the right edge
        {"CroppedAreaTopPixels": 15},
        {"CroppedAreaTopPixels": "nan"},
        {"FullPanoHeightPixels": 2**40},
        {"CroppedAreaImageHeightPixels": 0},
        {"CroppedAreaImageHeightPixels": 7.5},
    ],
)
def test_a_crop_that_cannot_be_is_none(tmp_path: Path, changes: dict[str, float | str]) -> None:
    path = write_still(tmp_path / "a.jpg", BLACK, panorama={**CROP, **changes})
    assert read_exif(path).crop is None
