"""One training iteration on the CPU, without autograd: that of a card is in `renderer.cuda.iteration`.

The gradients of the parameters exist for a thousand Gaussians at a time: the backward pass moves these
before the next thousand, while all is in a cache. A step of its own would write and read 236 bytes of each.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from panolog.renderer import ops
from panolog.renderer.adam import BETAS, EPSILON, Moving, check_moving
from panolog.renderer.cuda.iteration import Problem
from panolog.renderer.motion import MOTION_SUMS
from panolog.scene.gaussians import PARAMETERS


class Seen(NamedTuple):
    """What a camera sees of a problem's model."""

    given: dict[str, Any]  # what `ops.rasterize` took
    color: Tensor  # (H, W, 3)
    alpha: Tensor  # (H, W)
    inverse_depth: Tensor  # (H, W)
    state: Tensor  # (N,) uint8, State in csrc/formulas.h
    frame: list[Tensor]  # for the backward pass


class LossOf(NamedTuple):
    """Eq. 6 of an image."""

    value: float
    squared: float  # mean squared error of the colours
    by_color: Tensor  # (H, W, 3) the gradient of the value
    by_inverse_depth: Tensor  # (H, W)
    exposure: Tensor | None  # (3, 5) float64 as `losses.PhotometricLoss.exposure`


class Learnt(NamedTuple):
    """What a backward pass found besides the gradients of the parameters."""

    screen: Tensor | None  # (N, 2) gradients per pixel, (N, 4) with absolute ones; where they are wanted
    motion: Tensor | None  # (27,) float64 sums of the camera's motion, where the problem has it move


class Taken(NamedTuple):
    """An iteration."""

    seen: Seen
    loss: LossOf
    learnt: Learnt


def take(problem: Problem, moving: Mapping[str, Moving], step: int, *, screen: bool) -> Taken:
    """Forward and backward pass of eq. 6, and a step of what moves of the problem's model, in place.

    Raises as `loss_of` and `backward`.
    """
    seen = forward(problem)
    loss = loss_of(problem, seen.color, seen.inverse_depth)
    return Taken(seen, loss, backward(problem, seen, loss, moving, step, screen=screen))


def forward(problem: Problem) -> Seen:
    """The image of the problem's model."""
    at = problem.camera
    given = {
        **problem.model,
        "screen": torch.zeros(len(problem.model["means"]), 2),
        "rotation": at.rotation,
        "translation": at.translation,
        "width": at.width,
        "height": at.height,
        "sh_degree": problem.sh_degree,
        "near": problem.near,
        "exact": problem.exact,
        "exterior": [] if problem.exterior is None else problem.exterior.arrays(),
    }
    with torch.no_grad():
        color, alpha, inverse_depth, state, *frame = ops.rasterize(**given)
    return Seen(given, color, alpha, inverse_depth, state, frame)


def loss_of(problem: Problem, color: Tensor, inverse_depth: Tensor) -> LossOf:
    """Eq. 6 of a rendered image, color (H, W, 3) and inverse depth (H, W).

    Raises FloatingPointError with the word "loss" if it is not finite.
    """
    values, by_color, exposure = ops.photometric(
        color, problem.image, problem.mask, problem.lambda_ssim, problem.rows, problem.exposure
    )
    loss = values[0]
    if problem.share is not None:
        loss = loss * problem.share
        by_color.mul_(float(problem.share))
    by_inverse_depth = torch.zeros_like(inverse_depth)
    if problem.depth is not None:
        mean, by_inverse_depth = ops.absolute_difference(inverse_depth, *problem.depth)
        weighted, weight = problem.depth_weight * mean, problem.depth_weight
        if problem.depth_share is not None:
            weighted, weight = weighted * problem.depth_share, weight * float(problem.depth_share)
        loss = loss + weighted
        by_inverse_depth.mul_(weight)
    value = float(loss)
    if not math.isfinite(value):
        raise FloatingPointError("loss")
    sums = None if problem.exposure is None else exposure
    return LossOf(value, float(values[3]), by_color, by_inverse_depth, sums)


def backward(
    problem: Problem, seen: Seen, loss: LossOf, moving: Mapping[str, Moving], step: int, *, screen: bool
) -> Learnt:
    """The backward pass of an image, and a step of Adam of what moves, in place.

    Args: moving, by the names of the model's parameters, which share its memory; step, 1 for the first one,
    for the bias correction; screen, whether screen gradients are wanted.

    Raises:
        FloatingPointError: names a gradient that is not finite; the parameters are then invalid.
        ValueError: what moves does not fit.
    """
    check_moving(moving, step)
    count, kinds = len(seen.state), 2 if problem.absolute else 1
    by_screen = torch.empty(kinds, count, 2) if screen else None
    motion = torch.empty(MOTION_SUMS, dtype=torch.float64) if problem.moving else None
    images = {"color": seen.color, "alpha": seen.alpha, "inverse_depth": seen.inverse_depth}
    gradients = (loss.by_color, torch.zeros_like(seen.alpha), loss.by_inverse_depth)
    broken = ops.backward_into(
        seen.given | images | {f"grad_{name}": it for name, it in zip(images, gradients, strict=True)},
        seen.frame,
        out_screen=None if by_screen is None else by_screen[0].numpy(),
        out_absolute=None if by_screen is None or kinds == 1 else by_screen[1].numpy(),
        out_motion=None if motion is None else motion.numpy(),
        step=(tuple(_arrays(moving.get(name)) for name in PARAMETERS), *BETAS, EPSILON, step),
    )
    if broken:
        names = [name for place, name in enumerate(PARAMETERS) if broken >> place & 1]
        raise FloatingPointError(f"gradient of {names[0]}")
    found = None if by_screen is None else by_screen.movedim(0, 1).reshape(count, 2 * kinds)
    return Learnt(found, motion)


def _arrays(moving: Moving | None) -> tuple[object, ...] | None:
    """What `_core` takes of a parameter that moves, in its order; None for one that does not."""
    if moving is None:
        return None
    *tensors, count, lr, units = moving
    arrays = [tensor.detach().numpy() for tensor in tensors]
    return *arrays, count, lr, None if units is None else units.contiguous().numpy()
