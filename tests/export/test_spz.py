"""SPZ: values within the quantisation, bytes as the format says, and files that are none."""

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard

from panolog.export.splats import InMemory, Splats
from panolog.export.spz import Version, read_spz, write_spz
from panolog.scene.errors import FormatError
from tests.export.gaussians import matched, scattered, turn_between

MAGIC = b"NGSP"
BOTH: tuple[Version, ...] = (3, 4)


def plain(path: Path) -> bytes:
    """What is compressed in an SPZ, behind its first 16 bytes, for both versions."""
    packed = path.read_bytes()
    if not packed.startswith(MAGIC):
        return gzip.decompress(packed)
    (streams,) = packed[15:16]
    start, found = 32 + 16 * streams, packed[:16]
    for index in range(streams):
        size, length = struct.unpack_from("<QQ", packed, 32 + 16 * index)
        found += zstandard.ZstdDecompressor().decompress(packed[start : start + size], max_output_size=length)
        start += size
    assert start == len(packed)
    return found


@pytest.mark.parametrize("version", BOTH)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_return_within_the_quantisation(tmp_path: Path, version: Version, degree: int) -> None:
    splats, path = scattered(3000, degree, size=0.002), tmp_path / "a.spz"
    write_spz(path, InMemory(splats), version)
    found = read_spz(path)
    assert found.degree == degree
    was = matched(splats, found.means)
    assert np.abs(found.means - was.means).max() <= 2.0**-14  # the smallest Gaussians get more than 12 bits
    assert np.abs(found.scales - was.scales).max() <= 1 / 32 + 1e-5
    sigmoids = [1 / (1 + np.exp(-side.opacities)) for side in (found, was)]
    assert np.abs(sigmoids[0] - sigmoids[1]).max() <= 0.5 / 255 + 1e-5
    assert np.abs(found.sh0 - was.sh0).max() <= 0.5 / (0.15 * 255) + 1e-5
    assert turn_between(found.quats, was.quats).max() < 0.3
    assert np.abs(found.shN[:, :3] - was.shN[:, :3]).max(initial=0) <= 1 / 32 + 1e-5
    assert np.abs(found.shN[:, 3:] - was.shN[:, 3:]).max(initial=0) <= 1 / 16 + 1e-5


@pytest.mark.parametrize("version", BOTH)
def test_bytes_are_as_the_format_says(tmp_path: Path, version: Version) -> None:
    """One Gaussian, whose bytes follow from the README of nianticlabs/spz by hand."""
    half = np.sqrt(0.5)
    one = Splats(
        means=np.array([[1.5, -2, 0.25]], np.float32),
        quats=np.array([[half, 0, -half, 0]], np.float32),  # w x y z: y is largest
        scales=np.array([[0, -10, -1]], np.float32),
        opacities=np.array([0], np.float32),
        sh0=np.array([[0, 1, -10]], np.float32),
        shN=np.array([[[0, 0.5, -0.5], [0.03, 0.04, 1], [-1, 0, 0]]], np.float32),
    )
    path = tmp_path / "one.spz"
    write_spz(path, InMemory(one), version)
    found = plain(path)
    assert version == 4 or path.read_bytes()[:8] == b"\x1f\x8b\x08\x00\x00\x00\x00\x00"  # no name, no time
    expected = MAGIC + struct.pack("<IIBBBB", version, 1, 1, 12, 0, 6 if version == 4 else 0)
    for coordinate in (1.5, -2, 0.25):
        expected += struct.pack("<i", round(coordinate * 4096))[:3]
    expected += bytes([128, 128, 166, 0, 160, 0, 144])  # ½, 127.5 + 38.25 c, 16 (s + 10)
    negative = 1 << 9  # y is made positive, so the others are negative: w has 511 steps to √½
    expected += struct.pack("<I", 1 << 30 | negative << 20 | negative << 10 | negative | 511)
    expected += bytes([128, 192, 64, 132, 132, 255, 0, 128, 128])  # steps of 4/128 around 128
    assert found == expected


def test_version_2_has_the_first_three_of_a_rotation(tmp_path: Path) -> None:
    head = MAGIC + struct.pack("<IIBBBB", 2, 1, 0, 10, 0, 0)
    body = struct.pack("<i", 1024)[:3] * 3 + bytes([255, 128, 0, 255, 160, 160, 160, 255, 128, 127])
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + body))
    found = read_spz(tmp_path / "a.spz")
    np.testing.assert_array_equal(found.means, [[1, 1, 1]])
    np.testing.assert_allclose(found.quats, [[0, 1, 0, 0]], atol=0.01)
    assert found.opacities[0] == 30
    np.testing.assert_array_equal(found.scales, np.zeros((1, 3)))


def test_degree_4_and_extensions_are_left_out(tmp_path: Path) -> None:
    head = MAGIC + struct.pack("<IIBBBB", 3, 1, 4, 12, 2, 0)
    body = bytes(9 + 1 + 3 + 3 + 4) + bytes(range(128, 128 + 72)) + struct.pack("<II4x", 0xADBE0002, 4)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + body))
    found = read_spz(tmp_path / "a.spz")
    np.testing.assert_array_equal(found.shN.ravel(), np.arange(45) / 128)


def test_more_than_2048_units_is_refused(tmp_path: Path) -> None:
    path, splats = tmp_path / "far.spz", scattered(100)
    splats.means[7, 1] = 2047.9
    write_spz(path, InMemory(splats))
    assert read_spz(path).means.max() == pytest.approx(2047.9, abs=2e-4)
    before = path.read_bytes()
    splats.means[7, 1] = -2048.1
    with pytest.raises(FormatError, match="2048 units from the origin, and SPZ holds ±2048"):
        write_spz(path, InMemory(splats))
    splats.means[7, 1] = np.nan
    with pytest.raises(FormatError, match="a Gaussian is nan units"):
        write_spz(path, InMemory(splats))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["far.spz"]


def test_positions_have_as_many_bits_as_the_extent_permits(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    for extent, size, bits in [(2000, 1e-4, 12), (1000, 1e-4, 13), (50, 1.0, 12), (0.1, 1e-4, 16)]:
        splats = scattered(500, 0, extent=extent, size=size)
        write_spz(path, InMemory(splats))
        header = plain(path)[:16]
        assert header[13] == bits
        assert np.abs(read_spz(path).means - matched(splats, read_spz(path).means).means).max() <= 2.0**-bits


def header(version: int, count: int, degree: int = 0, bits: int = 12, streams: int = 0) -> bytes:
    return MAGIC + struct.pack("<IIBBBB", version, count, degree, bits, 0, streams)


def frames(count: int, *streams: bytes, sizes: tuple[int, ...] | None = None) -> bytes:
    """An SPZ of version 4. Args: sizes, as the table has them."""
    packed = [zstandard.compress(stream) for stream in streams]
    given = sizes or tuple(map(len, streams))
    table = b"".join(struct.pack("<QQ", len(p), size) for p, size in zip(packed, given, strict=True))
    return header(4, count, streams=len(streams)) + struct.pack("<I12x", 32) + table + b"".join(packed)


WRONG = {
    "empty": (b"", "is no SPZ"),
    "a newer version": (gzip.compress(header(5, 1) + bytes(100)), "is no SPZ of version"),
    "only a header": (gzip.compress(header(3, 1)), "truncated"),
    "degree 5": (gzip.compress(header(3, 1, 5) + bytes(500)), "header of the SPZ is damaged"),
    "99 bits": (gzip.compress(header(3, 1, 0, 99) + bytes(500)), "header of the SPZ is damaged"),
    "4 billion": (gzip.compress(header(3, 2**32 - 1) + bytes(100)), "cannot be in an SPZ of"),
    "more": (gzip.compress(header(3, 1) + bytes(21)), "more than its header says"),
    "a damaged gzip": (gzip.compress(header(3, 1))[:12] + bytes(100), "damaged"),
    "a wrong checksum": (gzip.compress(header(3, 1) + bytes(20))[:-8] + bytes(8), "damaged"),
    "no streams": (header(4, 1) + struct.pack("<I12x", 32), "streams"),
    "a table behind": (header(4, 1, streams=5) + struct.pack("<I12x", 2**32 - 1), "truncated"),
    "wrong sizes": (frames(1, *[bytes(9)] * 5), "sizes of the SPZ's streams"),
    "a bomb": (
        frames(1, bytes(2**26), bytes(1), bytes(3), bytes(3), bytes(4), sizes=(9, 1, 3, 3, 4)),
        "more than",
    ),
    "a short stream": (
        frames(2, bytes(9), bytes(2), bytes(6), bytes(6), bytes(8), sizes=(18, 2, 6, 6, 8)),
        "trunc",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_spz_is_one_line(tmp_path: Path, name: str) -> None:
    content, reason = WRONG[name]
    path = tmp_path / "a.spz"
    for nothing in (tmp_path, path):
        with pytest.raises(FormatError, match="no such file"):
            read_spz(nothing)
    path.write_bytes(content)
    with pytest.raises(FormatError, match=reason) as error:
        read_spz(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize("version", [2, 3])
def test_any_bytes_are_gaussians(tmp_path: Path, version: int) -> None:
    """Damage that is compressed has right checksums."""
    rng, path = np.random.default_rng(0), tmp_path / "a.spz"
    for degree in range(5):
        width = 9 + 1 + 3 + 3 + (3 if version == 2 else 4) + 3 * ((degree + 1) ** 2 - 1)
        path.write_bytes(gzip.compress(header(version, 500, degree) + rng.bytes(500 * width)))
        found = read_spz(path)
        assert all(np.isfinite(column).all() for column in found.columns().values())
        np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-5)
