"""The fused losses against the same in plain PyTorch."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from panolog.renderer.losses import (
    inverse_depth_loss,
    photometric_loss,
    sphere_rows,
    ssim_map,
    ssim_map_by_strips,
)


def slow_ssim(x: Tensor, y: Tensor, mask: Tensor | None = None) -> Tensor:
    """(H, W, 3) twice to (H, W, 3): Wang et al. 2004 by convolution, periodic in x, zero beyond the poles.

    With a mask (H, W) the means are those of the pixels where it is True and of the poles' zeros.
    """
    line = torch.exp(-(torch.arange(-5.0, 6.0, dtype=x.dtype) ** 2) / (2 * 1.5**2))
    line = line / line.sum()
    window = (line[:, None] * line[None])[None, None]

    def total(image: Tensor) -> Tensor:
        channels = image.permute(2, 0, 1)[:, None]
        wrapped = functional.pad(channels, (5, 5, 0, 0), mode="circular")
        return functional.conv2d(functional.pad(wrapped, (0, 0, 5, 5)), window)[:, 0].permute(1, 2, 0)

    on = torch.ones_like(x) if mask is None else mask[..., None].expand_as(x).to(x)
    share = 1 - total(1 - on) + 1e-12  # of the window's weight; where that is 0, nothing counts

    def mean(image: Tensor) -> Tensor:
        return total(image * on) / share

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    top = (2 * mx * my + 0.01**2) * (2 * cov + 0.03**2)
    return top / ((mx * mx + my * my + 0.01**2) * (vx + vy + 0.03**2))


def example(height: int = 24) -> tuple[Tensor, Tensor, Tensor]:
    rng = torch.Generator().manual_seed(0)
    color = torch.rand(height, 2 * height, 3, generator=rng) * 1.2
    target = torch.randint(0, 256, (height, 2 * height, 3), generator=rng, dtype=torch.uint8)
    return color, target, torch.rand(height, 2 * height, generator=rng) > 0.3


AFFINE = torch.tensor([[0.6, 1.0, 1.4], [0.03, 0.0, -0.05]])


def exposed(color: Tensor, truth: Tensor, affine: Tensor) -> Tensor:
    """What the loss compares, in plain torch."""
    image, white = color * affine[0] + affine[1], (affine[0] + affine[1]).clamp(min=1)
    below = torch.where(image > 1, 1 + (image - white).clamp(min=0), image)
    return torch.where((truth <= 0) & (image < 0), truth, torch.where(truth >= 1, below, image))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("sphere", [False, True])
@pytest.mark.parametrize(("weight", "affine"), [(0.0, None), (0.2, None), (1.0, None), (0.2, AFFINE)])
def test_photometric_loss_and_gradient(
    masked: bool, sphere: bool, weight: float, affine: Tensor | None
) -> None:
    agrees_with_the_definition(example()[2] if masked else None, weight, sphere, affine)


def part(rows: range, columns: range) -> Tensor:
    """Of an image of 24 × 48, a rectangle without a corner; columns go around the cylinder."""
    mask = torch.zeros(24, 48, dtype=torch.bool)
    mask[rows.start : rows.stop, [column % 48 for column in columns]] = True
    mask[rows.start, columns.start : columns.start + 3] = False
    return mask


def scattered() -> Tensor:
    """Rows are computed in runs of cells of 16 columns, of which the last one has 6 here."""
    mask = torch.zeros(51, 102, dtype=torch.bool)
    mask[4:40, 20:33] = mask[12:14, 98:] = mask[13:51, 60:61] = mask[45:, :30] = True
    mask[:9, 0] = mask[30, 101] = True
    return mask


PARTS = {
    "inside": part(range(9, 13), range(20, 30)),
    "over the seam, to a pole": part(range(2, 24), range(40, 60)),
    "to the seam": part(range(4, 24), range(43, 48)),
    "a gap of 11 columns, one more than two windows reach": part(range(24), range(3, 40)),
    "a gap of 10, so the whole width": part(range(24), range(3, 41)),
    "all columns": part(range(7), range(48)),
    "scattered": scattered(),
}


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("sphere", [False, True])
def test_a_loss_of_a_part_of_the_image(name: str, sphere: bool) -> None:
    agrees_with_the_definition(PARTS[name], 0.4, sphere)


def agrees_with_the_definition(
    mask: Tensor | None, weight: float, sphere: bool, affine: Tensor | None = None
) -> None:
    color, target, some = example(24 if mask is None else len(mask))
    target[:, ::5], target[:, 1::5] = 255, 0  # saturated, and black
    rows = sphere_rows(len(color), mask, "cpu") if sphere else None
    fast = color.clone().requires_grad_()
    ours = photometric_loss(fast, target, mask, weight, rows, affine)
    (3 * ours.loss).backward()  # type: ignore[no-untyped-call]

    exact = color.double().requires_grad_()
    truth = target.double() / 255
    on = torch.ones_like(some) if mask is None else mask
    seen = exact if affine is None else exposed(exact, truth, affine.double())
    image = torch.where(on[..., None], seen, truth)
    latitude = torch.linspace(-math.pi / 2, math.pi / 2, 2 * len(color) + 1, dtype=torch.float64)[1::2]
    area = ((latitude.cos() if sphere else torch.ones_like(latitude))[:, None] * on)[..., None]
    l1 = ((image - truth).abs() * area).sum() / (3 * area.sum())
    ssim = (slow_ssim(image, truth, mask) * area).sum() / (3 * area.sum())
    expected = (1 - weight) * l1 + weight * (1 - ssim)
    (3 * expected).backward()  # type: ignore[no-untyped-call]
    assert ours.loss.item() == pytest.approx(expected.item(), abs=1e-6)
    assert ours.l1 == pytest.approx(l1.item(), abs=1e-6)
    assert ours.ssim == pytest.approx(ssim.item(), abs=1e-6)
    assert ours.mse == pytest.approx(((image - truth) ** 2)[on].mean().item(), abs=1e-6)
    assert fast.grad is not None and exact.grad is not None
    assert (fast.grad - exact.grad).norm() < 1e-4 * exact.grad.norm()
    if mask is not None:
        assert not fast.grad[~mask].any()
    if affine is not None:
        beyond = (seen == truth) & ((truth == 0) | (truth == 1))
        assert beyond.any() and not fast.grad[beyond].any()


@pytest.mark.parametrize(
    "given",
    [{"mask": torch.ones(24, 48, dtype=torch.bool)}, {"exposure": torch.tensor([[1.0] * 3, [0.0] * 3])}],
    ids=["a mask that covers nothing", "an exposure of one"],
)
def test_what_says_nothing_changes_no_byte(given: dict[str, Any]) -> None:
    color, target, _ = example()
    target[:, ::5] = 255
    found = []
    for chosen in ({}, given):
        leaf = color.clone().requires_grad_()
        loss = photometric_loss(leaf, target, **chosen)
        loss.loss.backward()  # type: ignore[no-untyped-call]
        assert leaf.grad is not None and leaf.grad.any()
        found.append((loss.loss.item(), loss.l1, loss.ssim, loss.mse, leaf.grad.numpy().tobytes()))
    assert found[0] == found[1]


def test_nothing_under_a_mask_that_covers_all() -> None:
    color, target, mask = example()
    leaf = color.requires_grad_()
    ours = photometric_loss(leaf, target, torch.zeros_like(mask))
    ours.loss.backward()  # type: ignore[no-untyped-call]
    assert ours.l1 == 0
    assert leaf.grad is not None and not leaf.grad.any()


def test_ssim_wraps_around_the_seam() -> None:
    color, target, _ = example()
    truth = target.float() / 255
    ours = ssim_map(color, truth)
    assert torch.allclose(ours, slow_ssim(color.double(), truth.double()).mean(-1).float(), atol=1e-5)
    assert torch.allclose(ssim_map(color.roll(5, 1), truth.roll(5, 1)), ours.roll(5, 1), atol=1e-6)


@pytest.mark.parametrize("rows", [3, 8, 256])
@pytest.mark.parametrize("size", [(32, 64), (1, 2), (7, 14)])
def test_ssim_by_torch_operations_is_that_of_the_kernel(size: tuple[int, int], rows: int) -> None:
    generator = torch.Generator().manual_seed(2)
    noise, more = (torch.rand(*size, 3, generator=generator) for _ in range(2))
    smooth = torch.linspace(0, 1, size[1])[None, :, None].expand(*size, 3).contiguous()
    flat = torch.full_like(noise, 187 / 255)
    textured = [(noise, more), (noise, (noise + 0.1 * more).clamp(max=1)), (smooth, noise)]
    for a, b in (*textured, (flat, flat), (flat, flat + more / 255)):
        difference = (ssim_map_by_strips(a, b, rows) - ssim_map(a, b)).double()
        assert difference.abs().max() < (5e-4 if a is flat else 1e-5)
        assert difference.mean().abs() < (1e-4 if a is flat else 1e-6)


def test_inverse_depth_loss() -> None:
    rendered, target, chance = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0))
    valid = chance > 0.5
    leaf = rendered.clone().requires_grad_()
    loss = inverse_depth_loss(leaf, target, valid)
    assert loss.item() == pytest.approx(float((rendered - target).abs()[valid].mean()), abs=1e-6)
    (2 * loss).backward()  # type: ignore[no-untyped-call]
    expected = 2 * torch.sign(rendered - target) * valid / valid.sum()
    assert leaf.grad is not None and torch.allclose(leaf.grad, expected)
    assert float(inverse_depth_loss(rendered, target, torch.zeros_like(valid))) == 0


def test_shapes_that_do_not_fit_are_refused() -> None:
    color, target, mask = example()
    calls: list[Callable[[], object]] = [
        lambda: photometric_loss(color, target.float()),
        lambda: photometric_loss(color, target, mask[:-1]),
        lambda: photometric_loss(color[..., :1], target[..., :1]),
        lambda: photometric_loss(color[:, :0], target[:, :0]),
        lambda: photometric_loss(color, target, rows=torch.ones(len(color) - 1)),
        lambda: photometric_loss(color, target, exposure=torch.ones(3, 2)),
        lambda: inverse_depth_loss(color[..., 0], color[..., 1], mask[:-1]),
        lambda: inverse_depth_loss(color[..., 0].double(), color[..., 1], mask),
        lambda: ssim_map(color, color[:4]),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="must be"):
            call()


@pytest.mark.parametrize("sphere", [False, True])
def test_the_normal_equations_of_an_exposure(sphere: bool) -> None:
    """ExposureSums of csrc/kernels.h, in plain torch."""
    color, target, mask = example()
    target[:, ::5] = 255
    rows = sphere_rows(len(color), mask, "cpu") if sphere else None
    sums = photometric_loss(color, target, mask, 0.2, rows, AFFINE).exposure
    assert sums is not None
    truth, exact = target.double() / 255, color.double()
    image = exposed(exact, truth, AFFINE.double())
    r, s = image - truth, exact + 0.055
    free = mask[..., None] & (truth < 1) & ~((truth <= 0) & (image == truth))
    area = torch.ones(len(color), dtype=torch.float64) if rows is None else rows.double()
    w = (0.05 / r.abs().clamp(min=1e-12)).clamp(max=1) * free * area[:, None, None]
    expected = torch.stack([(w * term).sum((0, 1)) for term in (torch.ones_like(r), s, s * s, r, s * r)], 1)
    assert torch.allclose(sums, expected, rtol=1e-5, atol=1e-6)
