"""HEIC and AVIF panoramas become PNG that show, and say, the same."""

import shutil
import struct
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from panolog.prepare import file_kinds
from panolog.prepare.panorama_files import PanoramaFile, look_into
from panolog.prepare.sources.convert import as_png, displayed_size
from panolog.prepare.sources.gather import panoramas_in_folder
from panolog.prepare.world.exif import GpsFix, read_exif
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode_colors
from tests.scene.pictures.test_profiles import SHOWN, in_adobe, profile

HEIC = Path(__file__).with_name("turned.heic")  # of pillow-heif 1.8.1, quality 95, with what `_avif` has
PACKET = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
    ' GPano:PosePitchDegrees="3" GPano:PoseRollDegrees="0"/></rdf:RDF></x:xmpmeta>'
)


def _avif(path: Path) -> None:
    """A panorama in Adobe RGB whose left half is `SHOWN`, stored with a quarter turn, with all metadata."""
    picture = Image.new("RGB", (128, 64), (60, 60, 60))
    red, green, blue = in_adobe(SHOWN, 255)
    picture.paste((red, green, blue), (0, 0, 64, 64))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    details, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    details[ExifTags.Base.DateTimeOriginal] = "2026:05:04 03:02:01"
    details[ExifTags.Base.SubsecTimeOriginal] = "25"
    gps |= {1: "N", 2: (47.0, 22.0, 12.0), 3: "E", 4: (8.0, 32.0, 24.0), 5: b"\0", 6: 408.5}
    stored = picture.transpose(Image.Transpose.ROTATE_90)
    stored.save(
        path, quality=95, exif=exif.tobytes(), xmp=PACKET.encode(), icc_profile=profile(), subsampling="4:4:4"
    )


def _source(kind: str, folder: Path) -> PanoramaFile:
    path = folder / f"pano.{kind}"
    if kind == "avif":
        _avif(path)
    else:
        pytest.importorskip("pi_heif", reason="the extra `formats` is not installed")
        shutil.copy(HEIC, path)
    return PanoramaFile(folder, path.name, path)


@pytest.mark.parametrize("kind", ["heic", "avif"])
def test_pixels_colours_and_metadata_are_kept(kind: str, tmp_path: Path) -> None:
    panorama = _source(kind, tmp_path)
    assert displayed_size(panorama.path) == (128, 64)
    (found,) = as_png([panorama], tmp_path / "made")
    assert (found.name, found.path) == ("pano.png", tmp_path / "made" / "pano.png")
    pixels = decode_colors(found.path)[..., ::-1].astype(int)
    assert pixels.shape == (64, 128, 3)
    assert np.abs(pixels[8:-8, 8:56] - SHOWN).max() <= 4
    assert np.abs(pixels[8:-8, 72:-8] - 57).max() <= 4
    exif = read_exif(found.path)
    assert exif.fix == GpsFix(47.37, 8.54, 408.5)
    assert (exif.time, exif.orientation) == (datetime(2026, 5, 4, 3, 2, 1, 250_000), 1)
    assert exif.attitude is not None and exif.attitude.pitch == 3


def test_others_stay_as_they_are(tmp_path: Path) -> None:
    other = PanoramaFile(tmp_path, "a.jpg", tmp_path / "a.jpg")
    assert as_png([other], tmp_path / "made") == (other,)


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "cannot be decoded"), (b"\0" * 99, "cannot be decoded")]
)
def test_a_damaged_file_is_named(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.avif"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"a.avif: {words}"):
        as_png([PanoramaFile(tmp_path, path.name, path)], tmp_path / "made")


def test_a_truncated_file_is_named(tmp_path: Path) -> None:
    panorama = _source("avif", tmp_path)
    panorama.path.write_bytes(panorama.path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"pano\.avif: cannot be decoded"):
        as_png([panorama], tmp_path / "made")
    assert not list((tmp_path / "made").glob("*"))


@pytest.mark.parametrize(
    ("numbers", "words"), [((9, 16), "is in HDR"), ((12, 13), "has a wide gamut without")]
)
def test_colours_that_would_be_wrong_are_refused(
    numbers: tuple[int, int], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.avif"
    Image.new("RGB", (128, 64), (200, 10, 10)).save(path)
    before, mark, after = path.read_bytes().partition(b"colrnclx")
    assert mark
    path.write_bytes(before + mark + struct.pack(">HH", *numbers) + after[4:])
    with pytest.raises(InputError, match=words):
        as_png([PanoramaFile(tmp_path, path.name, path)], tmp_path / "made")


def test_a_folder_of_them_is_one_of_panoramas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.avif", "b.avif", "c.heic"):
        (tmp_path / name).touch()
    monkeypatch.setattr(file_kinds, "installed", lambda module: True)
    panoramas = panoramas_in_folder(tmp_path)
    assert [it.name for it in panoramas] == ["a.avif", "b.avif", "c.heic"]
    monkeypatch.setattr(file_kinds, "installed", lambda module: False)
    with pytest.raises(
        InputError, match=r"1 file \(c\.heic\): left out, each HEIC; pip install 'panolog\[fo"
    ):
        panoramas_in_folder(tmp_path)
    assert not look_into(tmp_path).images
