"""`rasterize` against `render`: channels, backgrounds, several cameras, depth, and gradients of poses."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.motion import MOTION, MOTION_SUMS
from panolog.renderer.rasterize import Raster, rasterize
from panolog.renderer.render import render
from panolog.scene.gaussians import SH_C0, Gaussians
from tests.renderer.hard_scenes import camera, cloud

CHANNELS = 7


def drawn(gaussians: Gaussians, *cameras: Camera, **options: Any) -> Raster:
    it = gaussians
    geometry = {"means": it.means, "quats": it.quats, "scales": it.scales, "opacities": it.opacities}
    return rasterize(**geometry, cameras=cameras, near=0.05, exact=it.exact, **options)


def harmonics(gaussians: Gaussians) -> Tensor:
    return torch.cat([gaussians.sh0, gaussians.shN], 1)


@pytest.fixture
def few() -> Gaussians:
    return cloud(30)


@pytest.mark.parametrize("exact", [False, True])
def test_harmonics_are_what_render_draws(few: Gaussians, exact: bool) -> None:
    gaussians, places = replace(few, exact=exact), [camera(64), camera(64)]
    places[1] = replace(places[1], translation=places[1].translation + 0.2)
    found = drawn(gaussians, *places, sh=harmonics(gaussians))
    for index, place in enumerate(places):
        expected = render(gaussians, place, near=0.05)
        assert torch.equal(found.color[index], expected.color)
        assert torch.equal(found.alpha[index], expected.alpha)
        assert torch.equal(found.inverse_depth[index], expected.inverse_depth)
        assert torch.equal(found.visible[index], expected.visible)
    linear = drawn(gaussians, places[0], sh=harmonics(gaussians)[:, :4])
    assert torch.equal(linear.color[0], render(gaussians, places[0], near=0.05, sh_degree=1).color)


def weights(gaussians: Gaussians, place: Camera) -> Tensor:
    """(H, W, N) what each Gaussian's colour is multiplied by, from renders of one-hot colours."""
    count = len(gaussians)
    images = []
    for first in range(0, count, 3):
        one_hot = torch.eye(count)[:, first : first + 3]
        flat = replace(gaussians, sh0=(one_hot[:, None] - 0.5) / SH_C0, shN=torch.zeros(count, 15, 3))
        images.append(render(flat, place, near=0.05, sh_degree=0).color)
    return torch.cat(images, -1)


def test_features_of_any_range_and_number_are_sums_with_their_gradients(few: Gaussians) -> None:
    place, random = camera(64), torch.Generator().manual_seed(1)
    scale = torch.tensor([1.0, 1e-3, 1e3, 0, 1, 5, 1])
    shift = torch.tensor([0.0, 0, 0, 0, -8, 0, 1e-2])
    features = torch.randn(len(few), CHANNELS, generator=random) * scale + shift
    features.requires_grad_()
    found = drawn(few, place, colors=features)
    assert found.color.shape == (1, 32, 64, CHANNELS)
    by_pixel = weights(few, place)
    with torch.no_grad():
        expected = by_pixel @ features
        slack = 1e-5 * (features.abs().amax(0) + 1e-6)
        assert ((found.color[0] - expected).abs() <= slack).all()
        assert expected[..., 0].min() < -0.1  # and not clamped
    factor = torch.randn(found.color.shape, generator=random)
    (found.color * factor).sum().backward()  # type: ignore[no-untyped-call]
    assert features.grad is not None
    by_sum = torch.einsum("hwn,hwx->nx", by_pixel, factor[0])
    torch.testing.assert_close(features.grad, by_sum, rtol=1e-3, atol=1e-4)


def test_channels_without_a_gaussian_that_is_not_finite_there_are_as_without_it(few: Gaussians) -> None:
    colors = torch.rand(len(few), 5, generator=torch.Generator().manual_seed(2))
    others = few.select(torch.arange(len(few)) > 0)
    expected = drawn(others, camera(64), colors=colors[1:]).color[..., 3]
    colors[0, 4] = torch.nan
    found = drawn(few, camera(64), colors=colors).color[..., 3]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def test_geometry_gets_the_gradients_of_all_channels(few: Gaussians) -> None:
    place = camera(64)
    colors = torch.rand(len(few), 6, generator=torch.Generator().manual_seed(2)) + 0.1
    gradients = []
    for parts in ([colors], [colors[:, :3], colors[:, 3:]]):
        leaves = few.with_tensors({n: t.clone().requires_grad_() for n, t in few.tensors().items()})
        rasters = [drawn(leaves, place, colors=part) for part in parts]
        sum((raster.color.square().sum() for raster in rasters), torch.zeros(())).backward()  # type: ignore[no-untyped-call]
        screens = [raster.screen.grad for raster in rasters]
        gradients.append((leaves.means.grad, leaves.scales.grad, sum(it for it in screens if it is not None)))
    for one, two in zip(*gradients, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-3)
        assert torch.as_tensor(one).abs().max() > 0


def test_a_background_is_seen_where_nothing_hides_it(few: Gaussians) -> None:
    place, colors = camera(64), torch.rand(len(few), 4)
    both = torch.tensor([[1.0, 2, 3, 4], [5, 6, 7, 8]]).requires_grad_()
    black, found = (drawn(few, place, place, colors=colors, **more) for more in ({}, {"background": both}))
    rest = 1 - black.alpha[..., None]
    torch.testing.assert_close(found.color, black.color + rest * both[:, None, None])
    torch.testing.assert_close(drawn(few, place, colors=colors, background=both[0]).color, found.color[:1])
    found.color.sum().backward()  # type: ignore[no-untyped-call]
    assert both.grad is not None
    torch.testing.assert_close(both.grad[0], rest[0].sum().expand(4))


def test_depth_is_the_distance_of_what_is_seen() -> None:
    means = torch.tensor([[0.0, 0, 3]])
    shape = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), -2.0), torch.tensor([9.0])
    place = Camera(torch.eye(3), torch.zeros(3), 64, 32)
    depth = rasterize(means, *shape, [place], colors=torch.ones(1, 3)).depth[0]
    assert depth[16, 32] == pytest.approx(3, rel=1e-2)
    assert torch.isinf(depth[0, 0])


def turned(turn: Tensor) -> Tensor:
    """(3, 3) the rotation by a rotation vector (3,)."""
    x, y, z = turn
    zero = torch.zeros_like(x)
    rotation: Tensor = torch.linalg.matrix_exp(
        torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    )
    return rotation


@pytest.mark.parametrize("exact", [False, True])
def test_poses_get_the_gradients_of_motions(few: Gaussians, exact: bool) -> None:
    """Of turns and shifts of a camera; `tests/renderer/poses` has motions against finite differences."""
    gaussians, at = replace(few, exact=exact), camera(64)
    factor = torch.randn(32, 64, 3, generator=torch.Generator().manual_seed(3))
    sums = torch.zeros(MOTION_SUMS, dtype=torch.float64, requires_grad=True)
    (render(gaussians, at, near=0.05, motion=sums).color * factor).sum().backward()  # type: ignore[no-untyped-call]
    motion = torch.zeros(MOTION, requires_grad=True)
    turn = turned(motion[3:])
    place = Camera(turn @ at.rotation, turn @ at.translation + motion[:3], at.width, at.height)
    (drawn(gaussians, place, sh=harmonics(gaussians)).color[0] * factor).sum().backward()  # type: ignore[no-untyped-call]
    assert motion.grad is not None and sums.grad is not None
    np.testing.assert_allclose(motion.grad.numpy(), sums.grad[:MOTION].numpy(), rtol=1e-4, atol=1e-4)


def test_wrong_arguments_are_errors(few: Gaussians) -> None:
    place, colors = camera(64), torch.ones(len(few), 3)
    with pytest.raises(ValueError, match="either colors or sh"):
        drawn(few, place)
    with pytest.raises(ValueError, match="either colors or sh"):
        drawn(few, place, colors=colors, sh=harmonics(few))
    with pytest.raises(ValueError, match="of one size"):
        drawn(few, place, camera(32), colors=colors)
    with pytest.raises(ValueError, match="0 cameras"):
        drawn(few, colors=colors)
    with pytest.raises(ValueError, match="must have 3 channels"):
        drawn(few, place, colors=colors, background=torch.ones(4))
    with pytest.raises(ValueError, match=f"must be float32 \\({len(few)}, 1, 4, 9 or 16, 3\\)"):
        drawn(few, place, sh=harmonics(few)[:, :5])
    for wrong in (colors[0], colors[:-1], colors.double(), colors > 0):
        with pytest.raises(ValueError, match=f"^colors is .* must be float32 \\({len(few)}, X\\)"):
            drawn(few, place, colors=wrong)
    assert not drawn(few, place, colors=colors).color.requires_grad
