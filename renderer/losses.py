"""The losses that need kernels: the photometric part of eq. 6 and the depth loss of eq. 5.

Their sums are taken in an order that no thread count changes, in double precision.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer import _core, ops


class PhotometricLoss(NamedTuple):
    """Means over the unmasked pixels."""

    loss: Tensor  # () differentiable: (1 - λ) L1 + λ (1 - SSIM)
    l1: Tensor  # () float64, as the others
    ssim: Tensor
    mse: Tensor


def photometric_loss(
    color: Tensor, target: Tensor, mask: Tensor | None = None, lambda_ssim: float = 0.2
) -> PhotometricLoss:
    """The photometric part of eq. 6.

    SSIM (Wang et al. 2004) with an 11 × 11 Gaussian window, σ = 1.5, which wraps horizontally and sees zeros
    beyond the poles. Masked pixels take no part: there, both images count as equal.

    Args:
        color: (H, W, 3) float32 rendered, in [0, 1] where it fits.
        target: (H, W, 3) uint8.
        mask: (H, W) bool, True where a pixel counts; None: everywhere.
        lambda_ssim: weight λ of the structural part, 0 to 1.

    Raises:
        ValueError: shapes or types do not fit.
    """
    _check_images(color, target, torch.float32, torch.uint8)
    if mask is not None and (mask.shape != color.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"mask is {mask.dtype} {tuple(mask.shape)}, must be bool {tuple(color.shape[:2])}")
    values, _ = ops.photometric(color, target, mask, lambda_ssim)
    return PhotometricLoss(values[0], *values.detach()[1:])


def inverse_depth_loss(rendered: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Eq. 5 without its weight: mean |rendered - target| over the valid pixels, 0 where there is none.

    Args:
        rendered: (H, W) float32 inverse radial depth, 1 / world units.
        target: (H, W) float32 aligned prior (eq. 4), the same unit.
        valid: (H, W) bool, the Ω of eq. 5.

    Raises:
        ValueError: shapes or types do not fit.
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


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of every pixel, mean over the channels, with the window of `photometric_loss`; on the CPU.

    Args:
        a, b: (H, W, 3) float32 in [0, 1].

    Returns:
        (H, W) float32.

    Raises:
        ValueError: shapes or types do not fit.
    """
    _check_images(a, b, torch.float32, torch.float32)
    height, width, _ = a.shape
    out = torch.empty((height, width))
    first, second = (image.detach().cpu().contiguous().numpy() for image in (a, b))
    _core.ssim_map(first, second, width, height, ops.threads(), out.numpy())
    return out


def _check_images(a: Tensor, b: Tensor, a_type: torch.dtype, b_type: torch.dtype) -> None:
    fits = a.shape == b.shape and a.dim() == 3 and a.shape[2] == 3 and a.numel() > 0
    if not fits or (a.dtype, b.dtype) != (a_type, b_type):
        raise ValueError(
            f"the images are {a.dtype} {tuple(a.shape)} and {b.dtype} {tuple(b.shape)}, "
            f"must be {a_type} and {b_type} of one (H, W, 3)"
        )
