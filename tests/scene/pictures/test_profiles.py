"""Pictures with a colour profile have the colours that a viewer shows."""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from panolog.orchestrator.watch.views.site.photographs import small_copy
from panolog.scene.image_files import decode_colors, decode_panorama
from panolog.scene.pictures.profiles import embedded_profile, to_srgb

ADOBE = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))  # chromaticities of Adobe RGB (1998), whose gamma is 2.2
SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
D50 = (0.9642, 1.0, 0.8249)
SHOWN = (180, 60, 50)  # in sRGB


def s15(*values: float) -> bytes:
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def matrix_of(primaries: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(3, 3) linear RGB to XYZ under D65."""
    xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in primaries]).T
    white = np.array([0.3127 / 0.329, 1, (1 - 0.3127 - 0.329) / 0.329])
    return np.asarray(xyz * np.linalg.solve(xyz, white))


def profile(primaries: tuple[tuple[float, float], ...] = ADOBE, gamma: float = 2.2) -> bytes:
    """A matrix profile of version 2, by ICC.1:2001-04; its colours are adapted to D50 by Bradford."""
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    white = matrix_of(primaries).sum(axis=1)
    scale = np.diag((bradford @ D50) / (bradford @ white))
    adapted = np.linalg.inv(bradford) @ scale @ bradford @ matrix_of(primaries)
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    tags = {b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), adapted.T, strict=True):
        tags[name] = b"XYZ \0\0\0\0" + s15(*column)
    return icc(b"RGB ", tags)


def icc(space: bytes, tags: dict[bytes, bytes]) -> bytes:
    """A profile of colours of a space, with its white point and other tags."""
    tags = tags | {b"wtpt": b"XYZ \0\0\0\0" + s15(*D50)}
    at, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, data in tags.items():
        table += name + struct.pack(">II", at + len(body), len(data))
        body += data
    kind = b"mntr" + space + b"XYZ " + bytes(12) + b"acsp"
    head = struct.pack(">I4x", at + len(body)) + bytes([2, 0x10, 0, 0]) + kind
    return head.ljust(68, b"\0") + s15(*D50) + bytes(48) + table + body


def in_adobe(color: tuple[int, int, int], most: int) -> list[int]:
    """The numbers, up to `most`, that show a colour of sRGB in Adobe RGB, from the formulas."""
    encoded = np.array(color) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    other = np.linalg.solve(matrix_of(ADOBE), matrix_of(SRGB) @ linear)
    return [int(value) for value in np.rint(other ** (1 / 2.2) * most)]


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp"])
def test_eight_bits_in_every_format(kind: str, tmp_path: Path) -> None:
    stored = Image.new("RGB", (64, 32), tuple(in_adobe(SHOWN, 255)))
    path = tmp_path / f"a.{kind}"
    stored.save(path, icc_profile=profile(), quality=100)
    stored.save(plain := tmp_path / f"plain.{kind}")
    assert embedded_profile(plain.read_bytes()) is None
    assert embedded_profile(path.read_bytes()) == profile()
    assert np.abs(decode_panorama(path)[3, 5].astype(int) - SHOWN).max() <= 2
    assert np.abs(decode_colors(path)[3, 5, ::-1].astype(int) - SHOWN).max() <= 2
    with path.open("rb") as file, Image.open(BytesIO(small_copy(file, path.name, 32))) as copied:
        assert np.abs(np.array(copied.getpixel((5, 3))) - SHOWN).max() <= 3
        assert "icc_profile" not in copied.info
    assert np.abs(decode_panorama(path, 32)[3, 5].astype(int) - SHOWN).max() <= 2
    assert np.abs(decode_panorama(plain)[3, 5].astype(int) - SHOWN).max() > 15


def test_sixteen_bits(tmp_path: Path) -> None:
    pixels = np.full((32, 64, 3), in_adobe(SHOWN, 65535)[::-1], np.uint16)
    data = bytes(cv2.imencode(".png", pixels)[1])
    named = b"x\0\0" + zlib.compress(profile())
    chunk = struct.pack(">I", len(named)) + b"iCCP" + named
    data = data[:33] + chunk + struct.pack(">I", zlib.crc32(b"iCCP" + named)) + data[33:]
    (tmp_path / "a").write_bytes(data)
    assert np.abs(decode_panorama(tmp_path / "a")[3, 5].astype(int) - SHOWN).max() <= 2


def test_grey_with_a_gamma_of_its_own(tmp_path: Path) -> None:
    """Its profile has one curve: a linear grey of a quarter is much lighter in sRGB."""
    grey = icc(b"GRAY", {b"kTRC": b"curv\0\0\0\0" + struct.pack(">I", 0)})
    Image.new("L", (64, 32), 64).save(tmp_path / "a.png", icc_profile=grey)
    expected = 255 * (1.055 * (64 / 255) ** (1 / 2.4) - 0.055)
    assert np.abs(decode_panorama(tmp_path / "a.png")[3, 5] - expected).max() <= 2


def test_profiles_that_change_nothing_or_are_damaged() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    cases = [own, own[:200], b"", bytes(1000), profile()[:300]]
    for content in cases:
        file = BytesIO()
        Image.fromarray(pixels[..., ::-1]).save(file, "PNG", icc_profile=content)
        data = file.getvalue()
        assert to_srgb(pixels, data) is pixels
        assert to_srgb(pixels, data[: len(data) // 3]) is pixels
