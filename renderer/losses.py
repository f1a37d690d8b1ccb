"""The losses that need kernels: the photometric part of eq. 6 and the depth loss of eq. 5.

Their sums are taken in an order that no thread count changes, in double precision.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer import _core, ops

_RADIUS, _SIGMA = 5, 1.5  # of the window of SSIM, in pixels
_C1, _C2 = 0.01**2, 0.03**2  # Wang et al. 2004, for samples in [0, 1]
_STRIP = 256  # rows whose windows are computed at a time: a fifth of a gigabyte at a width of 4096


class PhotometricLoss(NamedTuple):
    """Means over the unmasked pixels."""

    loss: Tensor  # () differentiable: (1 - λ) L1 + λ (1 - SSIM)
    l1: Tensor  # () float64, as the others
    ssim: Tensor
    mse: Tensor
    exposure: Tensor | None = None  # (3, 5) of each channel, ExposureSums in csrc/kernels.h; None without one


def photometric_loss(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    lambda_ssim: float = 0.2,
    rows: Tensor | None = None,
    exposure: Tensor | None = None,
) -> PhotometricLoss:
    """The photometric part of eq. 6, of the colours as the photograph's exposure has them.

    SSIM (Wang et al. 2004) with an 11 × 11 Gaussian window, σ = 1.5, which wraps horizontally and sees zeros
    beyond the poles. Masked pixels take no part: windows that reach over a mask's rim are normalised by the
    weight of their other pixels.

    Args:
        color: (H, W, 3) float32 rendered, in [0, 1] where it fits.
        target: (H, W, 3) uint8.
        mask: (H, W) bool, True where a pixel counts; None: everywhere.
        lambda_ssim: weight λ of the structural part, 0 to 1.
        rows: (H,) float32 weights of the rows in L1 and SSIM, such as `sphere_rows`; None: all 1.
        exposure: (2, 3) float32 factors and summands of the colours; None: 1 and 0. Where the target is
            saturated, all colours agree with it that are brighter, but not than white; where it is black,
            all that are darker.

    Raises:
        ValueError: shapes or types do not fit.

    >>> import torch, panolog
    >>> color = torch.full((32, 64, 3), 0.5, requires_grad=True)
    >>> found = panolog.photometric_loss(color, torch.full((32, 64, 3), 255, dtype=torch.uint8))
    >>> found.loss.backward()
    >>> round(found.l1.item(), 3), color.grad.shape
    (0.5, torch.Size([32, 64, 3]))
    """
    _check_images(color, target, torch.float32, torch.uint8)
    if mask is not None and (mask.shape != color.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, must be bool {tuple(color.shape[:2])}")
    if rows is not None and (rows.shape != color.shape[:1] or rows.dtype != torch.float32):
        raise ValueError(
            f"rows is {rows.dtype} {tuple(rows.shape)}, must be float32 {tuple(color.shape[:1])}"
        )
    if exposure is not None and (exposure.shape != (2, 3) or exposure.dtype != torch.float32):
        raise ValueError(f"exposure is {exposure.dtype} {tuple(exposure.shape)}, must be float32 (2, 3)")
    values, _, sums = ops.photometric(color, target, mask, lambda_ssim, rows, exposure)
    l1, ssim, mse = values.detach()[1:]
    return PhotometricLoss(values[0], l1, ssim, mse, None if exposure is None else sums)


def sphere_rows(height: int, mask: Tensor | None, device: torch.device | str) -> Tensor:
    """(height,) float32 weights of the rows in proportion to cos φ, the area of their pixels on the sphere.

    Their mean over the unmasked pixels is 1: L1 and SSIM become those of WS-PSNR's kind (Sun et al. 2017).

    Args: mask (height, W) bool, True where a pixel counts; None: everywhere.

    >>> import panolog
    >>> panolog.sphere_rows(4, None, "cpu").tolist()
    [0.585..., 1.414..., 1.414..., 0.585...]
    """
    latitude = ((torch.arange(height, dtype=torch.float64, device=device) + 0.5) / height - 0.5) * math.pi
    area = torch.cos(latitude)
    used = torch.ones_like(area) if mask is None else mask.sum(1, dtype=torch.float64)
    return (area * (used.sum() / (area * used).sum().clamp(min=1e-9))).float()


def inverse_depth_loss(rendered: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Eq. 5 without its weight: mean |rendered - target| over the valid pixels, 0 where there is none.

    Args:
        rendered: (H, W) float32 inverse radial depth, 1 / world units.
        target: (H, W) float32 aligned prior (eq. 4), the same unit.
        valid: (H, W) bool, the Ω of eq. 5.

    Raises:
        ValueError: shapes or types do not fit.

    >>> import torch, panolog
    >>> rendered, target, valid = torch.ones(2, 4), torch.zeros(2, 4), torch.ones(2, 4, dtype=torch.bool)
    >>> panolog.inverse_depth_loss(rendered, target, valid).item()
    1.0
    """
    types = [tensor.dtype for tensor in (rendered, target, valid)]
    if not rendered.shape == target.shape == valid.shape or types != [
        torch.float32,
        torch.float32,
        torch.bool,
    ]:
        raise ValueError(
            f"shapes {tuple(rendered.shape)}, {tuple(target.shape)}, {tuple(valid.shape)} of {types} "
            "must be one (H, W) of float32, float32 and bool"
        )
    value: Tensor = ops.absolute_difference(rendered, target, valid)[0]
    return value


@torch.no_grad()
def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of every pixel, mean over the channels, with the window of `photometric_loss`.

    It has no gradient, which `photometric_loss` has. On the CPU a kernel computes it, on a GPU
    `ssim_map_by_strips` does.

    Args:
        a, b: (H, W, 3) float32 in [0, 1].

    Returns:
        (H, W) float32, where the images are.

    Raises:
        ValueError: shapes or types do not fit.

    >>> import torch, panolog
    >>> image = torch.rand(32, 64, 3)
    >>> round(panolog.ssim_map(image, image).mean().item(), 3)
    1.0
    """
    _check_images(a, b, torch.float32, torch.float32)
    if a.is_cuda:
        return ssim_map_by_strips(a, b)
    height, width, _ = a.shape
    out = torch.empty((height, width))
    first, second = (image.detach().cpu().contiguous().numpy() for image in (a, b))
    _core.ssim_map(first, second, width, height, ops.threads(), out.numpy())
    return out


def ssim_map_by_strips(a: Tensor, b: Tensor, rows: int = _STRIP) -> Tensor:
    """`ssim_map` of checked images by torch operations, so many rows at a time.

    Equal to the kernel within 1e-5, and within 5e-4 where images hardly vary: float32 leaves of a variance
    no more there.
    """
    height, width, _ = a.shape
    columns = torch.arange(-_RADIUS, width + _RADIUS, device=a.device) % width
    strips = []
    for first in range(0, height, rows):
        last = min(first + rows, height)
        top, bottom = max(0, first - _RADIUS), min(height, last + _RADIUS)
        beyond = (0, 0, 0, 0, top - first + _RADIUS, last + _RADIUS - bottom)  # the poles
        x, y = (torch.nn.functional.pad(image[top:bottom, columns], beyond) for image in (a, b))
        strips.append(_similarity(x, y))
    return torch.cat(strips)


def _similarity(x: Tensor, y: Tensor) -> Tensor:
    """SSIM (h, w) of images (h + 2 r, w + 2 r, 3) with the window's radius r, mean over the channels."""
    mx, my, mxx, myy, mxy = map(_window_mean, (x, y, x * x, y * y, x * y))
    above = (2 * mx * my + _C1) * (2 * (mxy - mx * my) + _C2)
    below = (mx * mx + my * my + _C1) * ((mxx - mx * mx) + (myy - my * my) + _C2)
    return (above / below).mean(-1)


def _window_mean(x: Tensor) -> Tensor:
    """The window's mean (h, w, 3) around the inner pixels of (h + 2 r, w + 2 r, 3)."""
    bell = [math.exp(-((k / _SIGMA) ** 2) / 2) for k in range(-_RADIUS, _RADIUS + 1)]
    for dim in (1, 0):
        inner = x.shape[dim] - 2 * _RADIUS
        taps = [(weight / sum(bell), x.narrow(dim, k, inner)) for k, weight in enumerate(bell)]
        x = torch.zeros_like(taps[0][1])
        for weight, tap in taps:
            x.add_(tap, alpha=weight)
    return x


def _check_images(a: Tensor, b: Tensor, a_type: torch.dtype, b_type: torch.dtype) -> None:
    fits = a.shape == b.shape and a.dim() == 3 and a.shape[2] == 3 and a.numel() > 0
    if not fits or (a.dtype, b.dtype) != (a_type, b_type):
        raise ValueError(
            f"the images are {a.dtype} {tuple(a.shape)} and {b.dtype} {tuple(b.shape)}, "
            f"must be {a_type} and {b_type} of one (H, W, 3)"
        )
