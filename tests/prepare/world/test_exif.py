"""What image files say of themselves, in all the ways that cameras write it, and damaged."""

import io
import struct
import zlib
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo
from scipy.spatial.transform import Rotation

from panolog.prepare.world.exif import Attitude, Exif, GpsFix, read_exif
from panolog.scene.errors import InputError

GPS, BASE = ExifTags.GPS, ExifTags.Base
Angle = tuple[Fraction | int, Fraction | int, Fraction | int]
ZURICH: dict[int, object] = {
    GPS.GPSLatitudeRef: "N",
    GPS.GPSLatitude: (47, 22, Fraction(3912, 100)),
    GPS.GPSLongitudeRef: "E",
    GPS.GPSLongitude: (8, Fraction(325, 10), 0),
    GPS.GPSAltitudeRef: b"\0",
    GPS.GPSAltitude: Fraction(4085, 10),
}
FIX = GpsFix(47 + 22 / 60 + 39.12 / 3600, 8 + 32.5 / 60, 408.5)
TAKEN = datetime(2024, 5, 31, 12, 34, 56, 250_000)
HEAD = b'<?xpacket begin="\xef\xbb\xbf" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">'
RDF = b'<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""'
GPANO = b' xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
TAIL = b"</rdf:RDF></x:xmpmeta>" + b" " * 2000 + b'<?xpacket end="w"?>'
ATTRIBUTES = (
    HEAD + RDF + GPANO + b' GPano:PoseHeadingDegrees="225.0" GPano:PosePitchDegrees="17.0"'
    b' GPano:PoseRollDegrees="-121.0"/>' + TAIL
)
ELEMENTS = (
    HEAD
    + RDF
    + GPANO
    + b"><GPano:PoseHeadingDegrees>225.0</GPano:PoseHeadingDegrees><GPano:PosePitchDegrees>"
    b"17.0</GPano:PosePitchDegrees><GPano:PoseRollDegrees>-121.0</GPano:PoseRollDegrees></rdf:Description>"
    + TAIL
)
ATTITUDE = Attitude(225, 17, -121)


def exif(gps: dict[int, object] | None = None, time: bool = True) -> Image.Exif:
    tags = Image.Exif()
    tags[BASE.Make] = "RICOH"
    if gps is not None:
        tags[ExifTags.IFD.GPSInfo] = gps
    if time:
        tags[BASE.DateTime] = "2025:01:01 00:00:00"
        tags[ExifTags.IFD.Exif] = {
            BASE.DateTimeOriginal: "2024:05:31 12:34:56",
            BASE.SubsecTimeOriginal: "25",
            BASE.MakerNote: b"\x01" * 500,
        }
    return tags


def write(path: Path, tags: Image.Exif, xmp: bytes | None = None) -> Path:
    image = Image.new("RGB", (16, 8))
    if path.suffix == ".png":
        info = PngInfo()
        if xmp is not None:
            info.add_itxt("XML:com.adobe.xmp", xmp.decode(), zip=True)
        image.save(path, exif=tags, pnginfo=info)
    elif path.suffix == ".tif" and xmp is not None:
        whole = Image.Exif()
        whole.load(tags.tobytes())  # with its directories in one block, from which the TIFF's are copied
        whole[700] = xmp
        image.save(path, exif=whole)
    elif xmp is not None:
        image.save(path, exif=tags, xmp=xmp)
    else:
        image.save(path, exif=tags)
    return path


def gps(**changes: object) -> dict[int, object]:
    return {**ZURICH, **{int(GPS[name]): value for name, value in changes.items()}}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("xmp", [ATTRIBUTES, ELEMENTS])
def test_all_that_a_camera_writes(tmp_path: Path, suffix: str, xmp: bytes) -> None:
    found = read_exif(write(tmp_path / f"a{suffix}", exif(ZURICH), xmp))
    assert found.fix is not None
    assert (found.fix.latitude, found.fix.longitude) == pytest.approx((FIX.latitude, FIX.longitude), abs=1e-9)
    assert found.fix.altitude == 408.5
    assert found.time == TAKEN
    assert found.attitude == ATTITUDE


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
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
        ({"GPSLatitudeRef": "S", "GPSLongitudeRef": "W"}, GpsFix(-FIX.latitude, -FIX.longitude, 408.5)),
        ({"GPSAltitudeRef": b"\1"}, GpsFix(FIX.latitude, FIX.longitude, -408.5)),
        ({"GPSAltitude": Fraction(10**8)}, GpsFix(FIX.latitude, FIX.longitude, None)),
        ({"GPSLatitude": (0, 0, 0), "GPSLongitude": (0, 0, 0)}, None),
        ({"GPSLatitude": (90, 30, 0)}, None),
        ({"GPSLongitude": (181, 0, 0)}, None),
        ({"GPSLatitudeRef": ""}, None),
        ({"GPSLatitude": (1, 2)}, None),
    ],
)
def test_places(tmp_path: Path, change: dict[str, object], wanted: GpsFix | None) -> None:
    found = read_exif(write(tmp_path / "a.jpg", exif(gps(**change)))).fix
    if wanted is None:
        assert found is None
    else:
        assert found is not None
        assert (found.latitude, found.longitude) == pytest.approx((wanted.latitude, wanted.longitude))
        assert found.altitude == wanted.altitude


def test_numbers_without_denominator(tmp_path: Path) -> None:
    """Receivers without a place write 0/0."""
    path = write(tmp_path / "a.jpg", exif(gps(GPSLatitude=(47, 22, Fraction(391_234, 10_000)))))
    data = path.read_bytes()
    (tmp_path / "a.jpg").write_bytes(data.replace(struct.pack(">II", 195_617, 5_000), bytes(8)))
    assert read_exif(path).fix is None
    assert struct.pack(">II", 195_617, 5_000) in data


def test_time_of_the_file_where_the_camera_wrote_none(tmp_path: Path) -> None:
    tags = exif(time=False)
    assert read_exif(write(tmp_path / "a.jpg", tags)).time is None
    tags[BASE.DateTime] = "2025:01:02 03:04:05"
    assert read_exif(write(tmp_path / "a.jpg", tags)).time == datetime(2025, 1, 2, 3, 4, 5)
    tags[BASE.DateTime] = "0000:00:00 00:00:00"
    assert read_exif(write(tmp_path / "a.jpg", tags)).time is None


@pytest.mark.parametrize(
    ("written", "wanted"),
    [
        (b'GPano:PosePitchDegrees="-5"', Attitude(None, -5, 0)),
        (b'GPano:PoseHeadingDegrees="360"', Attitude(0, 0, 0)),
        (b'GPano:PosePitchDegrees="91" GPano:PoseRollDegrees="2"', Attitude(None, 0, 2)),
        (b'GPano:PosePitchDegrees="nan" GPano:PoseRollDegrees="inf"', None),
        (b'GPano:PosePitchDegrees="five"', None),
        (b'GPano:PosePitchDegrees="' + b"1" * 1000 + b'"', None),
        (b'GPano:ProjectionType="equirectangular"', None),
    ],
)
def test_attitudes(tmp_path: Path, written: bytes, wanted: Attitude | None) -> None:
    packet = HEAD + RDF + GPANO + b" " + written + b"/>" + TAIL
    assert read_exif(write(tmp_path / "a.jpg", exif(), packet)).attitude == wanted


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
    path = tmp_path / "a.png"
    Image.new("RGB", (16, 8)).save(path)
    data, end = path.read_bytes()[:-12], path.read_bytes()[-12:]
    for kind, content in (
        (b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + ELEMENTS),
        (b"eXIf", exif(ZURICH).tobytes()[6:]),
    ):
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


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_mutations_never_raise(tmp_path: Path, suffix: str) -> None:
    """Bytes changed, cut and repeated: what comes out is nothing or plausible."""
    whole = write(tmp_path / f"whole{suffix}", exif(ZURICH), ELEMENTS).read_bytes()
    random = np.random.default_rng(0)
    path = tmp_path / "mutated"
    for _ in range(200):
        data = bytearray(whole)
        for at in random.integers(len(data), size=random.integers(1, 12)):
            data[at] = (0, 255, 127, int(random.integers(256)))[random.integers(4)]
        if random.random() < 0.3:
            at, length = random.integers(len(data)), int(random.integers(1, 200))
            data[at : at + length] = b"" if random.random() < 0.5 else bytes(data[at : at + length]) * 2
        path.write_bytes(data)
        found = read_exif(path)
        if found.fix is not None:
            assert abs(found.fix.latitude) <= 90
            assert abs(found.fix.longitude) <= 180
        if found.attitude is not None:
            assert np.isfinite(found.attitude.up).all()


def test_a_damaged_part_leaves_the_other(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", exif(ZURICH), ELEMENTS)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"<rdf:RDF", b"<rdf;RDF"))
    assert (read_exif(path).attitude, read_exif(path).time) == (None, TAKEN)
    path.write_bytes(data.replace(b"Exif\0\0MM\0*", b"Exif\0\0MM\0\0"))
    assert (read_exif(path).attitude, read_exif(path).time) == (ATTITUDE, None)


def test_pixels_are_not_read(tmp_path: Path) -> None:
    """A file that ends within its pixels still says what it says."""
    path = tmp_path / "a.jpg"
    buffer = io.BytesIO()
    Image.effect_noise((256, 128), 50).save(buffer, "JPEG", exif=exif(ZURICH))
    path.write_bytes(buffer.getvalue()[:2000])
    assert read_exif(path).time == TAKEN
