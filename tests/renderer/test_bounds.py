"""The rows whose tiles are tested for an exactly projected Gaussian: all where it is seen, and few more."""

import math

import pytest
import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.scene.gaussians import Gaussians
from tests.renderer.agreement import NEAR
from tests.renderer.hard_scenes import camera, directions, placed
from tests.renderer.reference_rays import pixel_rays

WIDTH, COUNT = 256, 400
V, LOG2_OPACITY, REACH, HALF = 1, 5, 12, 15  # floats of SplatOf in csrc/formulas.h
CUT = math.log2(1 / 255)


def at_poles(log_scale: float, below: float) -> Gaussians:
    """So many whose centres are up to `below` radians from one of the poles."""
    rng = torch.Generator().manual_seed(3)
    spread = torch.rand(COUNT, generator=rng)
    sign = torch.where(torch.arange(COUNT) % 2 == 0, 1.0, -1.0)
    where = directions(torch.rand(COUNT, generator=rng) * 6.28, sign * (math.pi / 2 - spread * below))
    return placed(COUNT, where, camera(WIDTH), log_scale)


def projected(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """(N, 16) splats and their rays, of those that are visible."""
    at = camera(WIDTH)
    _, _, _, state, splats, rays, *_ = ops.rasterize(
        *scene.tensors().values(),
        torch.zeros(COUNT, 2),
        at.rotation,
        at.translation,
        at.width,
        at.height,
        3,
        NEAR,
        True,
        [],
    )
    visible = state == ops.VISIBLE
    return splats.view(-1, 16)[visible].double(), rays.view(-1, 16)[visible].double()


@pytest.mark.parametrize(("log_scale", "below"), [(-4.5, 0.05), (-3.0, 0.3), (-1.5, 0.8), (0.5, 1.5)])
def test_what_is_seen_of_a_gaussian_lies_in_its_rows(log_scale: float, below: float) -> None:
    splats, rays = projected(at_poles(log_scale, below))
    pixels = pixel_rays(camera(WIDTH)).double()
    x, y, along = (torch.einsum("nk,hwk->nhw", rays[:, i : i + 3], pixels) for i in (0, 3, 6))
    square = x**2 + y**2
    power = square / (along**2 + rays[:, 9, None, None] * square)
    seen = (along > 0) & (splats[:, LOG2_OPACITY, None, None] - power >= CUT)
    rows = torch.arange(WIDTH // 2).double() + 0.5
    inside = (rows - splats[:, V, None]).abs() <= splats[:, REACH, None]
    assert len(splats) > COUNT / 2 and seen.any(2).any(1).sum() > COUNT / 4
    assert not (seen.any(2) & ~inside).any()


def test_one_that_reaches_a_pole_is_tested_in_few_rows() -> None:
    splats, _ = projected(at_poles(-4.5, 0.01))
    around = splats[splats[:, HALF] >= WIDTH]
    assert len(around) > COUNT / 4
    assert float(around[:, REACH].max()) < WIDTH / 2 / 8
