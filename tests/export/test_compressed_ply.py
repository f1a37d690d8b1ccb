"""Compressed PLY: values within the quantisation, words as the format says, and files that are none."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from panolog.export.compressed_ply import read_compressed_ply, write_compressed_ply
from panolog.export.splats import InMemory, Splats
from panolog.scene.errors import PlyError
from tests.export.gaussians import C0, matched, scattered, turn_between

BOUNDS = [
    *("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"),
    *("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"),
    *("min_r", "min_g", "min_b", "max_r", "max_g", "max_b"),
]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def header(count: int, chunks: int = 1, rest: int = 0, bounds: list[str] = BOUNDS) -> str:
    """Of a compressed PLY."""
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in bounds]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in WORDS)]
    lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))] if rest else []
    return "\n".join([*lines, "end_header\n"])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_return_within_the_quantisation(tmp_path: Path, degree: int) -> None:
    splats, path = scattered(3000, degree, extent=5), tmp_path / "a.ply"
    write_compressed_ply(path, InMemory(splats))
    found = read_compressed_ply(path)
    assert found.degree == degree
    was = matched(splats, found.means)
    for start in range(0, 3000, 256):  # each chunk has bounds of its own
        rows = slice(start, start + 256)
        for name, steps in [
            ("means", (2047, 1023, 2047)),
            ("scales", (2047, 1023, 2047)),
            ("sh0", (255,) * 3),
        ]:
            values = was.columns()[name][rows]
            error = np.abs(found.columns()[name][rows] - values).max(axis=0)
            assert (error <= np.ptp(values, axis=0) / np.array(steps) / 2 + 1e-5).all()
    sigmoids = [1 / (1 + np.exp(-side.opacities)) for side in (found, was)]
    assert np.abs(sigmoids[0] - sigmoids[1]).max() <= 0.5 / 255 + 1e-5
    assert turn_between(found.quats, was.quats).max() < 0.3
    assert np.abs(found.shN - was.shN).max(initial=0) <= 1 / 64 + 1e-6


def test_a_far_sky_does_not_move_the_scene(tmp_path: Path) -> None:
    """Chunks with both, in which positions are units apart, were one of six."""
    scene, sky = scattered(3000, 0, extent=5), scattered(1000, 0, seed=1)
    around = 500 * sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    both = Splats.joined([scene, replace(sky, means=around)])
    write_compressed_ply(path := tmp_path / "a.ply", InMemory(both))
    error, _ = cKDTree(read_compressed_ply(path).means).query(scene.means)
    assert (error > 0.01).sum() < 256  # of one chunk between them


def test_words_are_unpacked_as_the_format_says(tmp_path: Path) -> None:
    """By hand, from PlayCanvas's description."""
    chunk = [0, 0, 0, 2047, 1023, 4094, -1, -2, -3, -1, -2, -3, 0, 0, 0, 1, 2, 255]
    words = struct.pack(
        "<4I", 1000 << 21 | 500 << 11 | 7, 2 << 30 | 0 << 20 | 511 << 10 | 1023, 0, 0x80FF01FF
    )
    body = struct.pack("<18f", *chunk) + words + bytes(range(100, 109))
    (tmp_path / "a.ply").write_bytes(header(1, rest=9).encode() + body)
    found = read_compressed_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(found.means, [[1000, 500, 14]], rtol=1e-6)
    q = np.array([-np.sqrt(0.5), (511 / 1023 - 0.5) * np.sqrt(2), 0, np.sqrt(0.5)])  # w x y z; y is largest
    np.testing.assert_allclose(found.quats[0], q, atol=1e-3)
    np.testing.assert_allclose(found.scales, [[-1, -2, -3]])
    np.testing.assert_allclose(found.sh0 * C0 + 0.5, [[128 / 255, 2, 1]], rtol=1e-6)
    assert found.opacities[0] == 30
    channels = (np.arange(100, 109).reshape(3, 3) + 0.5) / 32 - 4  # all of red, all of green, all of blue
    np.testing.assert_allclose(found.shN[0], channels.T)


def test_files_without_bounds_of_colours(tmp_path: Path) -> None:
    body = struct.pack("<12f", *range(12)) + struct.pack("<4I", 0, 0, 0, 0xFF007F80)
    (tmp_path / "a.ply").write_bytes(header(1, bounds=BOUNDS[:12]).encode() + body)
    found = read_compressed_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(found.sh0 * C0 + 0.5, [[1, 0, 127 / 255]], atol=1e-6)


def test_equal_gaussians_have_no_span(tmp_path: Path) -> None:
    write_compressed_ply(tmp_path / "a.ply", InMemory(scattered(1).select(np.zeros(300, int))))
    found, one = read_compressed_ply(tmp_path / "a.ply"), scattered(1)
    np.testing.assert_allclose(found.means, np.tile(one.means, (300, 1)), rtol=1e-6)
    np.testing.assert_allclose(found.sh0, np.tile(one.sh0, (300, 1)), atol=1e-5)


GOOD = header(1) + "\0" * 88
LONG = "ply\n" + "comment a\n" * 500
PLAIN = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n1234"
WRONG = {
    "a picture": ("\x89PNG\r\n\x1a\n", "is no compressed PLY"),
    "no end": (LONG, "header is damaged"),
    "a plain PLY": (PLAIN, "as PlayCanvas"),
    "ascii": (GOOD.replace("binary_little_endian", "ascii"), "binary"),
    "doubles": (GOOD.replace("property float min_x", "property double min_x"), "its header has"),
    "another type": (GOOD.replace("uint packed_scale", "float packed_scale"), "as PlayCanvas"),
    "too many chunks": (header(256, chunks=2) + "\0" * 9000, "as PlayCanvas"),
    "truncated": (GOOD[:-1], "truncated, 1 bytes are missing"),
    "a billion": (header(999_999_999, chunks=3_906_250) + "\0" * 88, "truncated"),
    "degree 4": (header(1, rest=72) + "\0" * 500, "as PlayCanvas"),
    "no numbers": (header(1) + "\xff" * 88, "no numbers"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_compressed_ply_is_one_line(tmp_path: Path, name: str) -> None:
    content, reason = WRONG[name]
    path = tmp_path / "a.ply"
    with pytest.raises(PlyError, match="no such file"):
        read_compressed_ply(path)
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(PlyError, match=reason) as error:
        read_compressed_ply(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
