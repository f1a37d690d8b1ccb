"""SPZ and compressed PLY: what others read of our files, and what we read of theirs."""

from pathlib import Path

import numpy as np
import pytest

from panolog.export.compressed_ply import read_compressed_ply, write_compressed_ply
from panolog.export.splats import InMemory, Splats
from panolog.export.spz import Version, read_spz, write_spz
from panolog.scene.ply import read_ply
from tests.export.gaussians import scattered, turn_between
from tests.export.peers import node, peer

pytestmark = pytest.mark.system

COUNT = 3001


def transformed(*arguments: str | Path) -> None:
    """Runs splat-transform, which may say nothing of errors."""
    script = peer("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    done = node(script, "-w", "-q", *arguments)
    assert done.returncode == 0, done.stderr
    assert "error" not in (done.stderr + done.stdout).lower(), done.stderr


def assert_equal(first: Splats, second: Splats) -> None:
    """Up to float32: splat-transform 3 turns neither PLY nor SPZ."""
    np.testing.assert_allclose(first.means, second.means, atol=1e-5)
    np.testing.assert_allclose(first.scales, second.scales, atol=1e-5)
    np.testing.assert_allclose(first.sh0, second.sh0, atol=1e-5)
    np.testing.assert_allclose(first.opacities.clip(-8, 8), second.opacities.clip(-8, 8), atol=1e-4)
    np.testing.assert_allclose(first.shN, second.shN[:, : first.shN.shape[1]], atol=1e-6)
    assert turn_between(first.quats, second.quats).max() < 0.05


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("version", [3, 4])
def test_splat_transform_reads_and_writes_spz(tmp_path: Path, version: Version, degree: int) -> None:
    ours, ply, theirs = tmp_path / "ours.spz", tmp_path / "their.ply", tmp_path / "theirs.spz"
    write_spz(ours, InMemory(scattered(COUNT, degree, size=0.004)), version)  # with more than 12 bits
    transformed(ours, ply)
    assert_equal(read_spz(ours), Splats.of(read_ply(ply)))
    transformed(ply, "--spz-version", str(version), theirs)
    found, was = read_spz(theirs), read_spz(ours)
    assert np.abs(found.means - was.means).max() <= 2.0**-13  # theirs has 12 bits
    np.testing.assert_allclose(found.shN, was.shN, atol=8 / 128)  # theirs has 5 and 4 bits, ours 6 and 5
    np.testing.assert_allclose(found.sh0, was.sh0)
    np.testing.assert_allclose(found.scales, was.scales)
    assert turn_between(found.quats, was.quats).max() < 0.05


@pytest.mark.parametrize("degree", [0, 2])
def test_splat_transform_reads_and_writes_compressed_ply(tmp_path: Path, degree: int) -> None:
    ours, ply, theirs = tmp_path / "ours.compressed.ply", tmp_path / "a.ply", tmp_path / "b.compressed.ply"
    write_compressed_ply(ours, InMemory(scattered(COUNT, degree)))
    transformed(ours, ply)
    assert_equal(read_compressed_ply(ours), Splats.of(read_ply(ply)))
    transformed(ply, theirs)
    transformed(theirs, ply)
    assert_equal(read_compressed_ply(theirs), Splats.of(read_ply(ply)))
    assert abs(theirs.stat().st_size - ours.stat().st_size) < 100  # the comment


@pytest.mark.parametrize("version", [3, 4])
def test_gsply_reads_and_writes_spz(tmp_path: Path, version: Version) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply of PyPI is not installed")
    write_spz(tmp_path / "ours.spz", InMemory(scattered(COUNT, size=0.004)), version)
    theirs, ours = gsply.read_spz(tmp_path / "ours.spz"), read_spz(tmp_path / "ours.spz")
    assert_equal(Splats(**{name: getattr(theirs, name) for name in ours.columns()}), ours)
    gsply.write_spz(tmp_path / "theirs.spz", theirs)
    again = read_spz(tmp_path / "theirs.spz")
    assert np.abs(again.means - ours.means).max() <= 2.0**-13  # theirs has 12 bits
    np.testing.assert_allclose(again.shN, ours.shN)


def test_gsply_reads_compressed_ply(tmp_path: Path) -> None:
    gsply = pytest.importorskip("gsply", reason="gsply of PyPI is not installed")
    path = tmp_path / "a.compressed.ply"
    write_compressed_ply(path, InMemory(scattered(COUNT)))
    theirs, ours = gsply.plyread(path), read_compressed_ply(path)
    assert_equal(Splats(**{name: getattr(theirs, name) for name in ours.columns()}), ours)
