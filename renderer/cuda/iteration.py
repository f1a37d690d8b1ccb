"""One training iteration on a card, without autograd and without a wait of the host.

What the host wants to know of an iteration the device writes into a report, which it reads later. Where a
step may not be taken, the device notes that in a status: then no Gaussian moves and the statistics of
densification stay, in this iteration and in all that were launched after it. As on the CPU the backward pass
takes the step: gradients of the parameters are never in memory. One that is not finite is found when others
have moved: then the model is invalid.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from panolog.renderer.adam import Moving
from panolog.renderer.baked import Baked
from panolog.renderer.camera import Camera
from panolog.renderer.cuda import losses, parts
from panolog.renderer.cuda.motion import room_for, with_motion
from panolog.renderer.cuda.parts import Launch
from panolog.scene.gaussians import PARAMETERS

REPORT = 4  # values: loss, mean squared error, pairs of splats and tiles, status; then motion
NO_ROOM, BROKEN_LOSS, BROKEN_GRADIENT = 1, 2, 4  # Status in csrc/cuda/common.cuh


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


def not_finite(status: int) -> str:
    """What is not finite where an iteration that had room ended with this status."""
    if status & BROKEN_LOSS:
        return "loss"
    broken = [name for place, name in enumerate(PARAMETERS) if status & BROKEN_GRADIENT << place]
    return f"gradient of {broken[0]}"


class Status:
    """Why no step may be taken any more, on a device."""

    def __init__(self, device: torch.device) -> None:
        self._both = torch.zeros(2, dtype=torch.int32, device=device)

    @property
    def known(self) -> Tensor:
        """(1,) int32, by the iterations before, by this one's room and loss, at its end by its gradients."""
        return self._both[:1]

    @property
    def broken(self) -> Tensor:
        """(1,) int32, of the gradients of the step that is taken."""
        return self._both[1:]

    def clear(self) -> None:
        """From here on steps may be taken again."""
        self._both.zero_()


class Seen(NamedTuple):
    """What a camera sees of a problem's model, on the device."""

    camera: bytes  # `parts.camera_struct`
    around: parts.Exterior | None
    projected: parts.Projected
    pairs: parts.Pairs
    color: Tensor  # (H, W, 3)
    alpha: Tensor  # (H, W)
    inverse_depth: Tensor  # (H, W)


class LossOf(NamedTuple):
    """Eq. 6 of an image, on the device."""

    report: Tensor  # (4,) float64, its last value after the step
    by_color: Tensor  # (H, W, 3) the gradient
    by_inverse_depth: Tensor  # (H, W)
    exposure: Tensor | None  # (3, 5) float64 as `PhotometricLoss.exposure`


class Found(NamedTuple):
    """What an iteration found; on the device."""

    screen: Tensor  # (N, 2) gradients per pixel
    absolute: Tensor | None  # (N, 2) absolute ones, where the problem has them
    state: Tensor  # (N,) uint8, State in csrc/formulas.h
    report: Tensor  # (4,) float64, or (4 + 27,)
    color: Tensor  # (H, W, 3) rendered
    inverse_depth: Tensor  # (H, W) rendered
    exposure: Tensor | None  # (3, 5) float64 as `PhotometricLoss.exposure`


def take(
    launch: Launch,
    problem: Problem,
    moving: Mapping[str, Moving],
    step: int,
    status: Status,
    room: int | None,
) -> Found:
    """Forward and backward pass of eq. 6, and a step of what moves of the problem's model, in place.

    Args: moving, by the names of the model's parameters, which share its memory; step, 1 for the first one;
    status, receives why a step may not be taken; room, for pairs of splats and tiles, without it the host
    waits for their number. Raises RunError where it waits and there are more than 2³¹.
    """
    seen = forward(launch, problem, room)
    return backward(launch, problem, seen, loss_of(launch, problem, seen, status), moving, step, status)


def forward(launch: Launch, problem: Problem, room: int | None) -> Seen:
    """The image of the problem's model. Args and errors: as of `take`."""
    at = problem.camera
    size = (at.width, at.height)
    camera = parts.camera_struct(at.rotation, at.translation, *size, problem.near, problem.exact)
    screen = problem.model["means"].new_zeros(len(problem.model["means"]), 2)
    angles = parts.half_pixels(*size, screen.device) if problem.exact else None
    around = problem.surroundings()
    projected = parts.project(launch, problem.model, screen, camera, problem.sh_degree, angles, around)
    pairs = parts.list_pairs(launch, projected, *size, room, around)
    images = parts.composite(launch, projected.splats, projected.rays, pairs, *size, around)
    return Seen(camera, around, projected, pairs, *images)


def loss_of(launch: Launch, problem: Problem, seen: Seen, status: Status) -> LossOf:
    """Eq. 6 of a rendered image, and whether a step may be taken by it."""
    images = seen.color, problem.image, problem.mask, problem.lambda_ssim, problem.rows
    sums, samples, by_color, exposure = losses.photometric_sums(
        launch, *images, problem.exposure, problem.share
    )
    depth_sum, depth_samples, by_depth = _depth_loss(launch, problem, seen.inverse_depth)
    pairs = seen.pairs
    report = torch.empty(REPORT, dtype=torch.float64, device=by_color.device)
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
        status=status.known,
        report=report,
    )
    return LossOf(report, by_color, by_depth, exposure)


def backward(
    launch: Launch,
    problem: Problem,
    seen: Seen,
    loss: LossOf,
    moving: Mapping[str, Moving],
    step: int,
    status: Status,
) -> Found:
    """The backward pass of an image, and a step of Adam of what moves, in place. Args: as of `take`."""
    at, projected = problem.camera, seen.projected
    motion = room_for(problem.model["means"], problem.moving)
    sums = parts.composite_backward(
        launch,
        projected.splats,
        projected.rays,
        seen.pairs.entries,
        seen.pairs.starts,
        at.width,
        at.height,
        len(projected.state),
        seen.around,
        absolute=problem.absolute,
        color=seen.color,
        alpha=seen.alpha,
        inverse_depth=seen.inverse_depth,
        grad_color=loss.by_color,
        grad_alpha=torch.zeros_like(seen.alpha),
        grad_inverse_depth=loss.by_inverse_depth,
    )
    frame = parts.Frame(seen.camera, problem.sh_degree, projected.splats, projected.tile_counts, sums, motion)
    known, broken = status.known, status.broken
    out = parts.project_step(launch, problem.model, moving, step, frame, known, broken)
    launch("iteration_end", (1, 1), 32, broken=broken, status=known, report=loss.report)
    report = with_motion(launch, loss.report, motion)
    images = seen.color, seen.inverse_depth
    return Found(out["screen"], out.get("absolute"), projected.state, report, *images, loss.exposure)


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
    status: Status,
    problem: Problem,
    gradient: Tensor,
    views: Tensor,
    *,
    absolute: Tensor | None = None,
    angle: bool = False,
    contribution: bool = False,
) -> None:
    """Adds a view to the first S rows as `workers.training.densify.Statistics.add`; none if status is not 0.

    Args: gradient, views and absolute (S,) float32, changed in place; how lengths and views are measured.
    """
    count, at = len(gradient), problem.camera
    size = (at.width, at.height)
    launch(
        "iteration_statistics",
        (-(-count // parts.THREADS), 1),
        parts.THREADS,
        count=count,
        screen=found.screen,
        absolute=found.absolute,
        state=found.state,
        means=problem.model["means"],
        camera=parts.camera_struct(at.rotation, at.translation, *size, problem.near, problem.exact),
        angle=int(angle),
        contribution=int(contribution),
        status=status.known,
        gradient=gradient,
        views=views,
        absolute_sum=absolute,
    )
