"""splat-transform, by the format's authors, reads what is written; what it writes is read with its values."""

from pathlib import Path

import numpy as np
import pytest

from panolog.export.order import morton_order
from panolog.export.sog.read import read_sog
from panolog.export.sog.write import write_sog, write_sog_folder
from panolog.export.splats import REST, InMemory, Splats
from panolog.scene.ply import read_ply, write_ply
from tests.export.peers import node, peer
from tests.export.sog.models import gaussians, splats, turned_alike

pytestmark = pytest.mark.system


def transform(*arguments: str | Path) -> None:
    """Runs splat-transform, which must neither fail nor warn."""
    done = node(peer("@playcanvas/splat-transform") / "bin/cli.mjs", "-w", *arguments)
    assert done.returncode == 0, done.stderr
    assert not any(word in (done.stdout + done.stderr).lower() for word in ("warn", "error", "nan"))


def read_back(path: Path) -> Splats:
    """What splat-transform makes of a SOG."""
    transform(path, path.with_suffix(".peer.ply"))
    return Splats.of(read_ply(path.with_suffix(".peer.ply")))


def assert_same(found: Splats, theirs: Splats) -> None:
    """Equal but for the last bits of quaternions, which are theirs without normalisation."""
    assert len(found) == len(theirs)
    for name in ("means", "scales", "opacities", "sh0"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(theirs, name), rtol=1e-6, atol=1e-7, err_msg=name
        )
    coefficients = REST[found.degree]
    np.testing.assert_array_equal(found.shN, theirs.shN[:, :coefficients])
    assert not theirs.shN[:, coefficients:].any()
    np.testing.assert_allclose(turned_alike(found.quats, theirs.quats), theirs.quats, atol=1e-5)


@pytest.mark.parametrize(("count", "degree"), [(1, 3), (63, 1), (5000, 0), (5000, 1), (5000, 2), (70_000, 3)])
def test_it_reads_what_is_written(tmp_path: Path, count: int, degree: int) -> None:
    model = splats(count, degree)
    write_sog(tmp_path / "a.sog", InMemory(model))
    theirs = read_back(tmp_path / "a.sog")
    assert_same(read_sog(tmp_path / "a.sog"), theirs)
    wanted = model.select(morton_order(model.means))
    steps = np.ptp(np.copysign(np.log1p(np.abs(wanted.means)), wanted.means), axis=0) / 65_535
    assert (np.abs(theirs.means - wanted.means) <= 0.51 * steps * (1 + np.abs(wanted.means)) + 1e-4).all()
    np.testing.assert_allclose(theirs.means.min(axis=0), wanted.means.min(axis=0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(theirs.means.max(axis=0), wanted.means.max(axis=0), rtol=1e-4, atol=1e-4)


def test_it_reads_a_folder(tmp_path: Path) -> None:
    write_sog_folder(tmp_path / "folder", InMemory(splats(800)))
    transform(tmp_path / "folder/meta.json", tmp_path / "peer.ply")
    assert_same(read_sog(tmp_path / "folder"), Splats.of(read_ply(tmp_path / "peer.ply")))


@pytest.mark.parametrize("name", ["a.sog", "meta.json"])
def test_what_it_writes_is_read(tmp_path: Path, name: str) -> None:
    write_ply(tmp_path / "model.ply", gaussians(splats(3000)))
    transform("-g", "cpu", tmp_path / "model.ply", tmp_path / name)
    transform(tmp_path / name, tmp_path / "peer.ply")
    assert_same(read_sog(tmp_path / name), Splats.of(read_ply(tmp_path / "peer.ply")))
