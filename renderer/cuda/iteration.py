"""The gradients of one training iteration on a card, without autograd and without a wait of the host.

What the host wants to know of an iteration the device writes into a report, which it reads later. Where a
step may not be taken, the device notes that in a status: then Adam and the statistics of densification do
nothing, in this iteration and in all that were launched after it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import losses, parts
from panolog.renderer.cuda.motion import room_for, with_motion
from panolog.renderer.cuda.parts import Launch

REPORT = 4  # values: loss, mean squared error, pairs of splats and tiles, status; then motion
NO_ROOM, BROKEN_GRADIENT, BROKEN_LOSS = 1, 2, 4  # Status in csrc/cuda/common.cuh


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """A model, and what its image should be."""

    model: Mapping[str, Tensor]  # N Gaussians as in `scene.gaussians`, contiguous
    camera: Camera  # its tensors on the CPU
    image: Tensor  # (H, W, 3) uint8
    mask: Tensor | None  # (H, W) bool
    share: Tensor | None = None  # () float64, a factor of the loss of the colours; None: 1
    depth: tuple[Tensor, Tensor] | None  # inverse depth (H, W) float32 and where it is valid (H, W) bool
    depth_share: Tensor | None = None  # as `share`, of the depth loss
    depth_weight: float
    lambda_ssim: float
    rows: Tensor | None  # (H,) float32 weights of the image's rows, `renderer.losses.sphere_rows`
    sh_degree: int
    near: float  # world units
    exact: bool = False  # `Gaussians.exact` of the model
    exterior: Baked | None = None  # what else the camera sees, on the device
    exposure: Tensor | None = None  # (2, 3) float32 as `renderer.losses.photometric_loss` has it
    moving: bool = False  # whether the report ends with the sums of the camera's motion
    absolute: bool = False  # whether there are absolute gradients; not with `exact`

    def surroundings(self) -> parts.Exterior | None:
        """The exterior as the parts take it."""
        arrays = [] if self.exterior is None else self.exterior.arrays()
        return parts.Exterior.of(arrays, self.camera.width, self.camera.height, self.exact)


class Found(NamedTuple):
    """What an iteration found; on the device."""

    gradients: dict[str, Tensor]  # shaped as the parameters; `screen` (N, 2) per pixel, and `absolute`
    state: Tensor  # (N,) uint8, State in csrc/formulas.h
    report: Tensor  # (4,) float64, or (4 + 27,)
    color: Tensor  # (H, W, 3) rendered
    inverse_depth: Tensor  # (H, W) rendered
    exposure: Tensor | None  # (3, 5) float64 as `PhotometricLoss.exposure`


def gradients(launch: Launch, problem: Problem, status: Tensor, room: int | None) -> Found:
    """Forward and backward pass of eq. 6.

    Args: status (1,) int32, receives why a step may not be taken; room for pairs of splats and tiles, without
    it the host waits for their number. Raises RunError where it waits and there are more than 2³¹.
    """
    at, degree = problem.camera, problem.sh_degree
    size = (at.width, at.height)
    camera = parts.camera_struct(at.rotation, at.translation, *size, problem.near, problem.exact)
    screen = problem.model["means"].new_zeros(len(problem.model["means"]), 2)
    angles = parts.half_pixels(*size, screen.device) if problem.exact else None
    around, motion = problem.surroundings(), room_for(problem.model["means"], problem.moving)
    projected = parts.project(launch, problem.model, screen, camera, degree, angles, around)
    pairs = parts.list_pairs(launch, projected, *size, room, around)
    splats, rays = projected.splats, projected.rays
    color, alpha, inverse_depth = parts.composite(launch, splats, rays, pairs, *size, around)
    images = color, problem.image, problem.mask, problem.lambda_ssim, problem.rows
    sums, samples, grad_color, by_exposure = losses.photometric_sums(
        launch, *images, problem.exposure, problem.share
    )
    depth_sum, depth_samples, grad_depth = _depth_loss(launch, problem, inverse_depth)
    listed = splats, rays, pairs.entries, pairs.starts
    by_splat = parts.composite_backward(
        launch,
        *listed,
        *size,
        len(screen),
        around,
        absolute=problem.absolute,
        color=color,
        alpha=alpha,
        inverse_depth=inverse_depth,
        grad_color=grad_color,
        grad_alpha=torch.zeros_like(alpha),
        grad_inverse_depth=grad_depth,
    )
    found = parts.project_backward(
        launch, problem.model, camera, degree, splats, projected.tile_counts, by_splat, status, motion
    )
    report = torch.empty(REPORT, dtype=torch.float64, device=status.device)
    launch(
        "iteration_guard",
        (1, 1),
        32,
        sums=sums,
        samples=samples,
        share=problem.share,
        lambda_ssim=problem.lambda_ssim,
        depth_sum=depth_sum,
        depth_samples=depth_samples,
        depth_share=problem.depth_share,
        depth_weight=float(problem.depth_weight),
        pairs=pairs.counts[-1:] if len(pairs.counts) else None,
        room=len(pairs.entries),
        status=status,
        report=report,
    )
    whole = with_motion(launch, report, motion)
    return Found(found, projected.state, whole, color, inverse_depth, by_exposure)


def _depth_loss(
    launch: Launch, problem: Problem, inverse_depth: Tensor
) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """() float64 its sum, and of how many pixels, both None without depth; its gradient (H, W)."""
    if problem.depth is None:
        return None, None, torch.zeros_like(inverse_depth)
    target = *problem.depth, problem.depth_share
    total, samples, gradient = losses.absolute_sum(launch, inverse_depth, *target)
    return total, samples, gradient.mul_(problem.depth_weight)


def add_statistics(
    launch: Launch,
    found: Found,
    status: Tensor,
    problem: Problem,
    gradient: Tensor,
    views: Tensor,
    *,
    absolute: Tensor | None = None,
    angle: bool = False,
    contribution: bool = False,
) -> None:
    """As `workers.training.densify.Statistics.add`: one view on the first S rows; none if status is not 0.

    Args: gradient, views and absolute (S,) float32, changed in place; how lengths and views are measured.
    """
    count, at = len(gradient), problem.camera
    size = (at.width, at.height)
    launch(
        "iteration_statistics",
        (-(-count // parts.THREADS), 1),
        parts.THREADS,
        count=count,
        screen=found.gradients["screen"],
        absolute=found.gradients.get("absolute"),
        state=found.state,
        means=problem.model["means"],
        camera=parts.camera_struct(at.rotation, at.translation, *size, problem.near, problem.exact),
        angle=int(angle),
        contribution=int(contribution),
        status=status,
        gradient=gradient,
        views=views,
        absolute_sum=absolute,
    )
