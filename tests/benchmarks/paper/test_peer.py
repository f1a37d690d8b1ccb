"""OpenSplat as a program that saves models on its way."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper import peer
from benchmarks.paper.measure import Gallery
from panolog.renderer.camera import Lens
from panolog.scene.errors import InputError, RunError
from panolog.scene.ply import write_ply
from panolog.scene.read import read_scene
from panolog.workers.training.initialise import scene_gaussians
from tests.scenes import write_scene

PROGRAM = """#!{python}
import shutil, sys, time
from pathlib import Path
at = sys.argv.index
output = Path(sys.argv[at("-o") + 1])
assert "--keep-crs" in sys.argv and Path(sys.argv[1], "sparse/0/images.bin").exists()
assert int(sys.argv[at("--resolution-schedule") + 1]) * 10 <= int(sys.argv[at("-n") + 1])
shutil.copy("{model}", output.with_name("splat_10.ply"))
{then}
shutil.copy("{model}", output)
"""


@pytest.fixture
def gallery(tmp_path: Path) -> Gallery:
    return Gallery(read_scene(write_scene(tmp_path / "scene")), 64, 0.01)


def program(tmp_path: Path, gallery: Gallery, then: str = "") -> Path:
    model, path = tmp_path / "model.ply", tmp_path / "opensplat"
    write_ply(model, scene_gaussians(gallery.scene))
    path.write_text(PROGRAM.format(python=sys.executable, model=model, then=then))
    path.chmod(0o755)
    return path


def test_faces_see_what_the_panorama_sees(tmp_path: Path, gallery: Gallery) -> None:
    import pycolmap  # noqa: PLC0415

    count = peer.write_faces(gallery, tmp_path / "project")
    assert count == 6 * len(gallery.scene.train) == len(list((tmp_path / "project" / "images").iterdir()))
    model = pycolmap.Reconstruction(str(tmp_path / "project" / "sparse" / "0"))
    names = {image.name: image for image in model.images.values()}
    camera = model.cameras[1]
    assert (camera.model.name, len(model.points3D)) == ("PINHOLE", len(gallery.scene.points))
    row = gallery.scene.train[0]
    panorama = gallery.scene.panoramas[row]
    pose = names[f"{row:05d}_1.jpg"].cam_from_world()  # a quarter turn to the right
    ahead = panorama.rotation.T @ (np.array([3.0, 0, 0]) - panorama.translation)
    np.testing.assert_allclose(pose * ahead, [0, 0, 3], atol=1e-9)
    assert camera.focal_length_x == pytest.approx(Lens(camera.width, camera.width, 96).focal)


def test_its_models_make_a_curve(tmp_path: Path, gallery: Gallery) -> None:
    found = peer.train(program(tmp_path, gallery), gallery, tmp_path / "out", 20, 600)
    assert (found.variant, len(found.curve), found.gaussians) == ("opensplat", 2, 50)
    assert found.metric("ws_psnr") == found.curve[-1].ws_psnr
    assert 0 <= found.curve[0].seconds <= found.total == found.curve[-1].seconds


@pytest.mark.nightly
def test_it_is_ended_when_the_time_is_over(tmp_path: Path, gallery: Gallery) -> None:
    copied = 'shutil.copy("{model}", output.with_name("splat_20.ply")); time.sleep(6000)'
    binary = program(tmp_path, gallery, copied.format(model=tmp_path / "model.ply"))
    found = peer.train(binary, gallery, tmp_path / "out", 20, 60)
    assert len(found.curve) == 1  # the last one may not be whole
    assert "ended after 60 s" in found.notes[0]


def test_its_failure_is_one_line(tmp_path: Path, gallery: Gallery) -> None:
    with pytest.raises(RunError, match="ended with 3"):
        peer.train(program(tmp_path, gallery, "sys.exit(3)"), gallery, tmp_path / "out", 20, 600)
    false = shutil.which("true")
    assert false is not None
    with pytest.raises(RunError, match="has saved no model"):
        peer.train(Path(false), gallery, tmp_path / "out", 20, 60)
    with pytest.raises(InputError, match="no such file"):
        peer.check(tmp_path / "nothing")
