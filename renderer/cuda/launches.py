"""The ops on CUDA: each as a sequence of the parts, with the arguments that torch's dispatcher passes."""

import torch
from torch import Tensor

from panolog.renderer.cuda.losses import absolute_sum, photometric_sums
from panolog.renderer.cuda.motion import motion_sums, room_for
from panolog.renderer.cuda.parts import (
    Exterior,
    Launch,
    Rays,
    Update,
    adam_step,
    camera_struct,
    composite,
    composite_backward,
    contiguous,
    half_pixels,
    list_pairs,
    project,
    project_backward,
)


def rasterize(
    launch: Launch,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    screen: Tensor,
    rotation: Tensor,
    translation: Tensor,
    width: int,
    height: int,
    sh_degree: int,
    near: float,
    exact: bool,
    exterior: list[Tensor],
    motion: Tensor | None = None,  # noqa: ARG001  # receives a gradient
) -> tuple[Tensor, ...]:
    """`ops.rasterize`: color, alpha, inverse depth, state and the frame for the backward pass.

    The frame is splats (16 (N + M),) with the M of the exterior, rays likewise or, without `exact`, (0,), the
    number of tiles that each meets (N + M,) int32, the rows of the splats of each tile (E,) int32, nearest
    first, and the index at which those of each tile start (T + 1,) int32.

    Raises:
        RunError: more than 2³¹ pairs of splats and tiles.
    """
    parameters = contiguous(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN)
    camera = camera_struct(*_here(rotation, translation), width, height, near, exact)
    angles = half_pixels(width, height, means.device) if exact else None
    around = Exterior.of(exterior, width, height, exact)
    projected = project(launch, parameters, screen[:, :2].contiguous(), camera, sh_degree, angles, around)
    splats, seen, state, _, tile_counts = projected
    listed = list_pairs(launch, projected, width, height, exterior=around)
    images = composite(launch, splats, seen, listed, width, height, around)
    rays = splats.new_empty(0) if seen is None else seen.rays
    return *images, state, splats, rays, tile_counts, listed.entries, listed.starts


def rasterize_backward(
    launch: Launch,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    screen: Tensor,
    rotation: Tensor,
    translation: Tensor,
    width: int,
    height: int,
    sh_degree: int,
    near: float,
    exact: bool,
    exterior: list[Tensor],
    color: Tensor,
    alpha: Tensor,
    inverse_depth: Tensor,
    frame: list[Tensor],
    grad_color: Tensor,
    grad_alpha: Tensor,
    grad_inverse_depth: Tensor,
    moving: bool = False,
) -> tuple[Tensor, ...]:
    """`ops.rasterize_backward`: gradients of means, quats, scales, opacities, sh0, shN, screen; motion."""
    splats, rays, tile_counts, entries, starts = frame
    sums = composite_backward(
        launch,
        splats,
        Rays(rays, *half_pixels(width, height, splats.device)) if exact else None,
        entries,
        starts,
        width,
        height,
        len(means),
        Exterior.of(exterior, width, height, exact),
        absolute=screen.shape[1] == 4,
        **contiguous(color=color, alpha=alpha, inverse_depth=inverse_depth, grad_color=grad_color),
        **contiguous(grad_alpha=grad_alpha, grad_inverse_depth=grad_inverse_depth),
    )
    parameters = contiguous(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN)
    camera = camera_struct(*_here(rotation, translation), width, height, near, exact)
    motion = room_for(means, moving)
    out = project_backward(launch, parameters, camera, sh_degree, splats, tile_counts, sums, motion=motion)
    if screen.shape[1] == 4:
        out["screen"] = torch.cat([out["screen"], out.pop("absolute")], 1)
    found = means.new_empty(0, dtype=torch.float64) if motion is None else motion_sums(launch, motion)
    return *out.values(), found


def photometric(
    launch: Launch,
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    lambda_ssim: float,
    rows: Tensor | None = None,
    exposure: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`ops.photometric`."""
    images = color, target, mask, lambda_ssim, rows, exposure
    sums, samples, gradient, normal = photometric_sums(launch, *images)
    l1, ssim, squared = (sums / samples).unbind()
    loss = (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim)
    return (
        torch.stack([loss, l1, ssim, squared]),
        gradient,
        sums.new_empty(0, 5) if normal is None else normal,
    )


def absolute_difference(
    launch: Launch, rendered: Tensor, target: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """`ops.absolute_difference`: the mean over valid pixels, () float64, and its gradient (H, W)."""
    total, samples, gradient = absolute_sum(launch, rendered, target, valid)
    return total / samples, gradient


def adam(
    launch: Launch,
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    count: int,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
    units: Tensor | None = None,
) -> None:
    """`ops.adam`: one step on the first `count` values, in place."""
    update = Update(gradient.contiguous(), parameter, exp_avg, exp_avg_sq, count, lr, units)
    adam_step(launch, [update], beta1, beta2, eps, step)


def _here(rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    """A pose on the CPU: the host waits for one that is on the card."""
    return rotation.detach().cpu(), translation.detach().cpu()
