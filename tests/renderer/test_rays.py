"""Exact projection: the kernels against the definition, on every instruction set that this processor has."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from panolog.renderer import _core, ops
from panolog.renderer.camera import Camera
from panolog.renderer.render import Render, render
from panolog.scene.gaussians import Gaussians
from tests.renderer.agreement import NEAR, check_definition
from tests.renderer.hard_scenes import as_leaves, camera, cloud, directions, placed, scenes


@pytest.mark.parametrize("name", scenes(camera(), exact=True))
@pytest.mark.parametrize(("width", "degree"), [(64, 0), (64, 3), (202, 3)])
def test_values_and_gradients_agree_with_the_definition(
    name: str, width: int, degree: int, instruction_set: str
) -> None:
    at = camera(width)
    check_definition(scenes(at, exact=True)[name], at, degree)


def rendered(scene: Gaussians, at: Camera) -> Render:
    return render(replace(scene, exact=True), at, near=NEAR)


def test_a_panorama_turned_by_whole_pixels_is_the_same_panorama() -> None:
    at = camera(96)
    angle = 2 * math.pi * 7 / 96
    turn = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    turned = Camera(turn @ at.rotation, turn @ at.translation, 96, 48)
    one, other = rendered(cloud(300), at).color, rendered(cloud(300), turned).color
    assert (torch.roll(one, 7, dims=1) - other).abs().max() < 1e-4


def test_a_round_gaussian_is_a_circle_on_the_sphere_wherever_it_is_seen() -> None:
    """Also at the pole, where an affine splat is not: the response depends on the angle alone."""
    at = Camera(torch.eye(3), torch.zeros(3), 256, 128)
    middle = torch.tensor([[0.1, 2.0, 0.05]])  # near the nadir
    ball = placed(1, middle, at, -0.5)
    ball = ball.with_tensors(ball.tensors() | {"scales": torch.full((1, 3), -0.5)})
    alpha = rendered(ball, at).alpha
    v, u = torch.meshgrid(torch.arange(128) + 0.5, torch.arange(256) + 0.5, indexing="ij")
    azimuth, elevation = u / 256 * 2 * math.pi - math.pi, v / 128 * math.pi - math.pi / 2
    level = elevation.cos()
    rays = torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], -1)
    angle = torch.acos((rays @ (middle[0] / middle.norm())).clamp(max=1))
    order = angle.flatten().argsort()
    falling = alpha.flatten()[order]
    assert falling[0] > 0.1
    assert (falling[1:] - falling[:-1]).max() < 1e-3


def test_the_number_of_threads_changes_nothing() -> None:
    at = camera(202)
    results = []
    for threads in (1, 3):
        ops.use_threads(threads)
        try:
            leaves = as_leaves(replace(cloud(5000), exact=True), torch.float32)
            made = render(leaves, at, near=NEAR)
            (made.color.sum() + made.inverse_depth.sum()).backward()  # type: ignore[no-untyped-call]
            results.append([made.color, *(leaf.grad for leaf in leaves.tensors().values())])
        finally:
            ops.use_threads(None)
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("parameter", ["means", "quats", "scales", "opacities", "sh0"])
def test_what_is_not_finite_is_left_out(parameter: str) -> None:
    scene = cloud(50)
    broken = scene.tensors()[parameter].clone()
    broken[7] = math.nan
    at = camera()
    made = rendered(scene.with_tensors(scene.tensors() | {parameter: broken}), at)
    without: Tensor = torch.arange(50) != 7
    assert made.invalid.tolist() == (~without).tolist()
    assert torch.equal(made.color, rendered(scene.select(without), at).color)


def test_the_affine_splats_of_small_gaussians_are_nearly_the_same() -> None:
    """Both are the same model to first order: they may differ by the filter alone, at the horizon."""
    at = Camera(torch.eye(3), torch.zeros(3), 256, 128)
    spread = torch.rand(200, generator=torch.Generator().manual_seed(4))
    small = placed(200, directions(spread * 6.28, (spread.flip(0) - 0.5) * 0.2, 30.0), at, -1.5)
    affine, exact = render(small, at).color, rendered(small, at).color
    assert affine.max() > 0.1
    assert (affine - exact).abs().max() < 0.02 * affine.max()


def test_few_gaussians(instruction_set: str) -> None:
    for count in (0, 1):
        assert rendered(cloud(count), camera()).color.shape == (32, 64, 3)
    assert _core.instruction_set() == instruction_set
