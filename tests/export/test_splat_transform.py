"""splat-transform, by the authors of SOG: it reads what we write, and we read what it writes."""

import json
from pathlib import Path

import numpy as np
import pytest

from panolog.export.compressed_ply import write_compressed_ply
from panolog.export.order import morton_order
from panolog.export.reading import read_model
from panolog.export.sog.read import read_sog
from panolog.export.sog.streamed import write_streamed
from panolog.export.sog.write import write_sog
from panolog.export.splats import InMemory, Splats
from panolog.export.spz import write_spz
from panolog.scene.ply import read_ply, write_ply
from tests.export.gaussians import scattered, turn_between
from tests.export.peers import node, peer
from tests.export.sog.models import source, splats, write_unpacked

pytestmark = [pytest.mark.system, pytest.mark.nightly]

COUNT = 3001


def transformed(*arguments: str | Path) -> None:
    """Runs splat-transform, which must neither fail nor warn."""
    done = node(peer("@playcanvas/splat-transform") / "bin" / "cli.mjs", "-w", *arguments)
    assert done.returncode == 0, done.stderr
    assert not any(word in (done.stdout + done.stderr).lower() for word in ("warn", "error", "nan"))


def as_read(path: Path) -> Splats:
    """What splat-transform makes of a file."""
    transformed(path, path.with_suffix(".peer.ply"))
    return Splats.of(read_ply(path.with_suffix(".peer.ply")))


def assert_equal(found: Splats, theirs: Splats) -> None:
    """Up to float32, and to their quaternions, which are not normalised."""
    assert len(found) == len(theirs)
    for name in ("means", "scales", "sh0"):
        np.testing.assert_allclose(getattr(found, name), getattr(theirs, name), atol=1e-5, err_msg=name)
    np.testing.assert_allclose(found.opacities.clip(-8, 8), theirs.opacities.clip(-8, 8), atol=1e-4)
    coefficients = found.shN.shape[1]
    np.testing.assert_allclose(found.shN, theirs.shN[:, :coefficients], atol=1e-6)
    assert not theirs.shN[:, coefficients:].any()
    assert turn_between(found.quats, theirs.quats).max() < 0.05


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("kind", ["spz 3", "spz 4", "compressed.ply"])
def test_spz_and_compressed_ply(tmp_path: Path, kind: str, degree: int) -> None:
    """Theirs has 12 bits of SPZ's positions, and 5 and 4 bits of its harmonics; ours more, 6 and 5."""
    suffix, _, version = kind.partition(" ")
    ours, theirs = tmp_path / f"ours.{suffix}", tmp_path / f"theirs.{suffix}"
    model = InMemory(scattered(COUNT, degree, size=0.004))
    write_spz(ours, model, 3 if version == "3" else 4) if version else write_compressed_ply(ours, model)
    was = read_model(ours)
    assert_equal(was, as_read(ours))
    transformed(ours.with_suffix(".peer.ply"), *(["--spz-version", version] if version else []), theirs)
    found = read_model(theirs)
    if not version:
        assert_equal(found, as_read(theirs))
        assert abs(theirs.stat().st_size - ours.stat().st_size) < 100  # the comment
        return
    assert np.abs(found.means - was.means).max() <= 2.0**-13
    np.testing.assert_allclose(found.shN, was.shN, atol=8 / 128)
    np.testing.assert_allclose([found.sh0, found.scales], [was.sh0, was.scales])
    assert turn_between(found.quats, was.quats).max() < 0.05


@pytest.mark.parametrize(("count", "degree"), [(1, 3), (63, 1), (5000, 0), (5000, 2), (70_000, 3)])
def test_sog(tmp_path: Path, count: int, degree: int) -> None:
    model = splats(count, degree)
    write_sog(tmp_path / "a.sog", InMemory(model))
    theirs = as_read(tmp_path / "a.sog")
    assert_equal(read_sog(tmp_path / "a.sog"), theirs)
    wanted = model.select(morton_order(model.means)).means
    steps = np.ptp(np.copysign(np.log1p(np.abs(wanted)), wanted), axis=0) / 65_535
    assert (np.abs(theirs.means - wanted) <= 0.51 * steps * (1 + np.abs(wanted)) + 1e-4).all()


@pytest.mark.parametrize("name", ["a.sog", "meta.json"])
def test_sog_of_theirs_and_in_a_folder(tmp_path: Path, name: str) -> None:
    write_unpacked(tmp_path / "ours", source(800))
    assert_equal(read_sog(tmp_path / "ours"), as_read(tmp_path / "ours/meta.json"))
    write_ply(tmp_path / "model.ply", splats(3000).gaussians())
    transformed("-g", "cpu", tmp_path / "model.ply", tmp_path / name)
    assert_equal(read_sog(tmp_path / name), as_read(tmp_path / name))


def test_levels_of_a_streamed_sog(tmp_path: Path) -> None:
    folder = tmp_path / "web"
    write_streamed(folder, source(9000, 1), source(50, 0, seed=9), side=8, most=1500, levels=3)
    meta = json.loads((folder / "lod-meta.json").read_text())
    for level in range(3):
        transformed("-L", str(level), folder / "lod-meta.json", tmp_path / f"{level}.ply")
        names = [name for name in meta["filenames"] if name.startswith(f"{level}_")]
        own = Splats.joined([read_sog(folder / name) for name in names])
        theirs = read_ply(tmp_path / f"{level}.ply")
        assert len(theirs) == meta["counts"][level] == len(own)
        np.testing.assert_allclose(theirs.means.numpy(), own.means, rtol=1e-6)
