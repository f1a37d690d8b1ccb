"""The sky as a picture."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from panolog.export.frame import Frame
from panolog.export.sky import render_sky, write_sky_image
from panolog.export.splats import ModelSource, Selection, Splats
from panolog.scene.errors import InputError
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.ply import write_ply
from tests.export.gaussians import scattered

UP = (0.0, 0.0, 1.0)


def sky(frame: Frame) -> Gaussians:
    """A sphere around the origin of a frame: red towards its −z, green towards +x, blue above, else grey."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colours = np.full((4000, 3), 0.5)
    colours[directions[:, 2] < -0.8] = 1, 0, 0
    colours[directions[:, 0] > 0.8] = 0, 1, 0
    colours[directions[:, 1] > 0.8] = 0, 0, 1
    means = 100 * directions @ frame.rotation + frame.origin
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(4000, 1),
        scales=torch.full((4000, 3), float(np.log(4))),
        opacities=torch.full((4000,), 4.0),
        sh0=torch.from_numpy(((colours - 0.5) / 0.28209479177387814).astype(np.float32))[:, None],
        shN=torch.zeros(4000, 15, 3),
        sky=4000,
    )


def test_directions() -> None:
    frame = Frame.upright(UP, np.array([50.0, -20, 3]))
    image = render_sky(sky(frame), frame, 128)
    assert image.shape == (64, 128, 3)
    np.testing.assert_allclose(image[32, 64], [1, 0, 0], atol=0.05)  # the middle: −z
    np.testing.assert_allclose(image[32, 96], [0, 1, 0], atol=0.05)  # to its right: +x
    np.testing.assert_allclose(image[2, 64], [0, 0, 1], atol=0.05)  # above
    np.testing.assert_allclose(image[32, 2], [0.5, 0.5, 0.5], atol=0.05)  # behind


def test_below_the_horizon_colours_are_continued() -> None:
    frame = Frame.upright(UP)
    whole = sky(frame)
    above = whole.select(whole.means[:, 2] > 0)
    image = render_sky(above, frame, 128)
    assert np.isfinite(image).all()
    assert image[40:].min() > 0.2  # not black
    np.testing.assert_allclose(image[20, 30], render_sky(whole, frame, 128)[20, 30], atol=0.02)


@pytest.mark.parametrize("far", [20_000.0, 500.0])
def test_viewers_get_a_sky_that_looks_the_same_and_is_near(tmp_path: Path, far: float) -> None:
    """Only where it is much farther than the scene."""
    scene, path = scattered(300, extent=20), tmp_path / "model.ply"
    center, around = np.array([3.0, -2.0, 1.0]), sky(Frame.upright(UP))
    means = torch.from_numpy(center + far * (around.means / 100).numpy()).float()
    around = around.with_tensors(around.tensors() | {"means": means}, sky=len(around))
    write_ply(path, concatenate(scene.gaussians(), around))
    source = ModelSource(path, Selection(part="all"))
    before, after = (Splats.joined(list(it.pieces())) for it in (source, source.with_near_sky()))
    factor = (after.means[300:] - means.numpy().mean(0)) / (before.means[300:] - means.numpy().mean(0))
    reach = np.linalg.norm(scene.means - means.numpy().mean(0), axis=1).max()
    expected = min(1.0, 20 * reach / far)
    np.testing.assert_allclose(factor, expected, rtol=0.02)
    np.testing.assert_allclose(after.scales[300:] - before.scales[300:], np.log(expected), atol=0.02)
    for name, column in before.columns().items():
        np.testing.assert_array_equal(column[:300], after.columns()[name][:300])


def test_files(tmp_path: Path) -> None:
    image = np.linspace(0, 1.2, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)
    write_sky_image(tmp_path / "sky.jpg", image)
    found = cv2.imread(str(tmp_path / "sky.jpg"))
    assert found is not None
    assert np.abs(found[:, :, ::-1] / 255 - image.clip(0, 1)).mean() < 0.02
    exr = pytest.importorskip("OpenEXR")
    write_sky_image(tmp_path / "sky.exr", image)
    pixels = exr.File(str(tmp_path / "sky.exr")).channels()["RGB"].pixels
    np.testing.assert_allclose(pixels[0, 0], 0, atol=1e-3)
    assert pixels[-1, -1].max() > 1.2  # linear light, not cut at 1
    with pytest.raises(OSError, match=r"sky\.exr: .*No such file"):
        write_sky_image(tmp_path / "none" / "sky.exr", image)
    with pytest.raises(InputError, match=r"sky\.png: the picture of a sky is \.jpg or \.exr"):
        write_sky_image(tmp_path / "sky.png", image)
    assert {path.name for path in tmp_path.iterdir()} == {"sky.jpg", "sky.exr"}
