"""The losses on CUDA, as parts: sums and gradients, which the host does not wait for."""

import math

import torch
from torch import Tensor

from panolog.renderer.cuda.parts import THREADS, Argument, Launch, contiguous, tiles_of


def photometric_sums(
    launch: Launch,
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    lambda_ssim: float,
    rows: Tensor | None = None,
    exposure: Tensor | None = None,
    share: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """(3,) float64 sums of |x - y|, SSIM and (x - y)², of how many samples; the loss's gradient (H, W, 3).

    Args: rows (H,) float32, weights of the rows in L1 and SSIM; exposure (2, 3) float32, factors and summands
    of the colours; share () float64, a factor of the gradient. The last result is (3, 5) float64 of
    ExposureSums in csrc/kernels.h by channel, None without exposure.
    """
    height, width, _ = color.shape
    color, target = color.contiguous(), target.contiguous()
    used = None if mask is None else mask.contiguous().view(torch.uint8)
    if mask is None:
        samples = color.new_full((), 3 * width * height, dtype=torch.float64)
    else:
        samples = _count(mask).mul_(3)
    grid = tiles_of(width, height)
    by = color.new_empty(3, *color.shape)
    partials = color.new_empty(grid[0] * grid[1], 3, dtype=torch.float64)
    gradient = torch.empty_like(color)
    normal = None if exposure is None else color.new_empty(grid[0] * grid[1], 15, dtype=torch.float64)
    problem: dict[str, Argument] = {
        "color": color,
        "target": target,
        "mask": used,
        "rows": None if rows is None else rows.contiguous(),
        "exposure": None if exposure is None else exposure.contiguous(),
        "width": width,
        "height": height,
        "lambda_ssim": lambda_ssim,
        "count": samples if share is None else samples / share,
        "by": by,
    }
    launch("loss_similarity", grid, THREADS, **problem, partials=partials, normal=normal)
    launch("loss_gradient", grid, THREADS, **problem, gradient=gradient)
    return partials.sum(0), samples, gradient, None if normal is None else normal.sum(0).view(3, 5)


def absolute_sum(
    launch: Launch, rendered: Tensor, target: Tensor, valid: Tensor, share: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """() float64 sum over valid pixels, of how many, and the gradient of the mean (H, W) times `share`."""
    pixels = rendered.numel()
    samples = _count(valid)
    blocks = math.ceil(pixels / THREADS)
    partials = rendered.new_empty(blocks, dtype=torch.float64)
    gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
    launch(
        "loss_absolute",
        (blocks, 1),
        THREADS,
        **contiguous(rendered=rendered, target=target, valid=valid.view(torch.uint8)),
        pixels=pixels,
        count=samples if share is None else samples / share,
        gradient=gradient,
        partials=partials,
    )
    return partials.sum(), samples, gradient


def _count(mask: Tensor) -> Tensor:
    """() float64: how many are True, at least 1; known to the device only, the host does not wait for it."""
    return mask.sum(dtype=torch.float64).clamp_(min=1)
