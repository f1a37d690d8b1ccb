import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from panolog.renderer.camera import Camera, Lens, facing, perspective
from panolog.renderer.render import encode_png, hatched, render_panorama, to_bytes
from panolog.scene.gaussians import Gaussians
from tests.renderer.reference_rays import pixel_rays

PANORAMA = Camera(torch.eye(3), torch.zeros(3), 512, 256)


def paint(rays: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A smooth colour for each direction."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    color: NDArray[np.uint8] = np.rint(127.5 + 120 * unit).astype(np.uint8)
    return color


@pytest.mark.parametrize("yaw", [0, 90, 180, -135])
@pytest.mark.parametrize("pitch", [0, 90, -90, 30])
def test_every_direction_shows_what_is_there(yaw: float, pitch: float) -> None:
    lens, direction = Lens(96, 64, 90), facing(yaw, pitch)
    seen = perspective(paint(pixel_rays(PANORAMA).numpy()), lens, direction)
    x = (np.arange(96) + 0.5 - 48) / lens.focal
    y = (np.arange(64) + 0.5 - 32) / lens.focal
    rays = np.stack([*np.meshgrid(x, y), np.ones((64, 96))], axis=-1) @ direction.T
    assert np.abs(seen.astype(int) - paint(rays).astype(int)).max() <= 2


def test_facing_turns_right_and_up() -> None:
    np.testing.assert_allclose(facing(90, 0) @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(facing(0, 90) @ [0, 0, 1], [0, -1, 0], atol=1e-12)  # y points down
    np.testing.assert_allclose(facing(90, 30) @ [0, 0, 1], [np.cos(np.pi / 6), -0.5, 0], atol=1e-12)


def test_a_lens_asks_for_a_panorama_as_fine_as_its_edge() -> None:
    lens = Lens(1000, 500, 90)
    assert lens.focal == pytest.approx(500)
    step = np.arctan(1.0) - np.arctan(1 - 1 / 500)  # radians between the last two columns
    assert 2 * np.pi / lens.panorama_width == pytest.approx(step, rel=2e-3)
    assert lens.panorama_width % 2 == 0
    assert Lens(8000, 8000, 170).panorama_width == 16_384


@pytest.mark.parametrize(("width", "fov"), [(0, 90), (100, 0), (100, 180), (100, float("nan"))])
def test_impossible_lenses_are_refused(width: int, fov: float) -> None:
    with pytest.raises(ValueError, match=r"field of view|is empty"):
        Lens(width, 100, fov)


def test_colours_are_clamped_and_rounded() -> None:
    color = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert to_bytes(color).tolist() == [[[0, 128, 255]]]


def test_a_gaussian_ahead_is_in_the_middle_of_the_panorama() -> None:
    one = Gaussians(
        means=torch.tensor([[0.0, 0.0, 5.0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), -2.0),
        opacities=torch.tensor([4.0]),
        sh0=torch.tensor([[[1.0, -1.0, -1.0]]]),
        shN=torch.zeros(1, 15, 3),
    )
    panorama = render_panorama(one, np.eye(3), np.zeros(3), 128, near=0.1)
    assert panorama.shape == (64, 128, 3)
    rows, columns = np.nonzero(panorama[..., 0] > 100)
    assert abs(rows.mean() + 0.5 - 32) < 0.1
    assert abs(columns.mean() + 0.5 - 64) < 0.1
    decoded = cv2.imdecode(np.frombuffer(encode_png(panorama), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(np.asarray(decoded)[..., ::-1], panorama)
    assert not render_panorama(one, np.eye(3), np.zeros(3), 128, near=10.0).any()


def test_what_is_not_rendered_is_pale_under_diagonal_lines() -> None:
    image = np.zeros((96, 192, 3), np.uint8)
    image[:, 96:] = 255
    found = hatched(image)
    lines = (found == 232).all(axis=2)
    assert 0.2 < lines.mean() < 0.4
    assert (lines[:-1, 1:] == lines[1:, :-1]).all() and not (lines[:-1] == lines[1:]).all()
    assert found.min() >= 96  # no part of it is black
    assert (
        found[:, 96:][~lines[:, 96:]].mean() > found[:, :96][~lines[:, :96]].mean() + 50
    )  # it can be recognised
