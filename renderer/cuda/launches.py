"""The ops on CUDA: each as a sequence of the parts, with the arguments of the op by their names."""

from typing import Any

import torch
from torch import Tensor

from panolog.renderer.cuda.baking import surroundings
from panolog.renderer.cuda.losses import absolute_sum, photometric_sums
from panolog.renderer.cuda.motion import motion_sums, room_for
from panolog.renderer.cuda.parts import (
    Exterior,
    Frame,
    Launch,
    Pairs,
    Projected,
    Rays,
    camera_struct,
    composite,
    composite_backward,
    contiguous,
    half_pixels,
    list_pairs,
    project,
    project_backward,
)
from panolog.scene.gaussians import PARAMETERS

_IMAGES = ("color", "alpha", "inverse_depth", "grad_color", "grad_alpha", "grad_inverse_depth")


def _problem(given: dict[str, Any]) -> tuple[dict[str, Tensor], bytes, Exterior | None]:
    """The parameters, the camera, and what is around. The host waits for a pose that is on the card."""
    size, exact = (given["width"], given["height"]), given["exact"]
    rotation, translation = (given[name].detach().cpu() for name in ("rotation", "translation"))
    camera = camera_struct(rotation, translation, *size, given["near"], exact)
    parameters = contiguous(**{name: given[name] for name in PARAMETERS})
    return parameters, camera, Exterior.of(given["exterior"], *size, exact)


def _seen(launch: Launch, given: dict[str, Any], screen: Tensor) -> tuple[Projected, Pairs, Exterior | None]:
    """Splats as projected, their pairs with tiles, and what is around. Args: screen (N, 2), contiguous."""
    parameters, camera, around = _problem(given)
    size = (given["width"], given["height"])
    angles = half_pixels(*size, screen.device) if given["exact"] else None
    projected = project(launch, parameters, screen, camera, given["sh_degree"], angles, around)
    return projected, list_pairs(launch, projected, *size, exterior=around), around


def _rays(projected: Projected) -> Tensor:
    """The rays of the splats (16 N,); (0,) with affine projection."""
    return projected.splats.new_empty(0) if projected.rays is None else projected.rays.rays


def rasterize(launch: Launch, **given: Any) -> tuple[Tensor, ...]:
    """`ops.rasterize`: color, alpha, inverse depth, state and the frame for the backward pass.

    The frame is splats (16 (N + M),) with the M of the exterior, rays likewise or, without `exact`, (0,), the
    number of tiles that each meets (N + M,) int32, the rows of the splats of each tile (E,) int32, nearest
    first, and the index at which those of each tile start (T + 1,) int32.

    Raises:
        RunError: more than 2³¹ pairs of splats and tiles.
    """
    projected, listed, around = _seen(launch, given, given["screen"][:, :2].contiguous())
    splats, seen, state, _, tile_counts = projected
    images = composite(launch, splats, seen, listed, given["width"], given["height"], around)
    return *images, state, splats, _rays(projected), tile_counts, listed.entries, listed.starts


def rasterize_backward(launch: Launch, **given: Any) -> tuple[Tensor, ...]:
    """`ops.rasterize_backward`: gradients of means, quats, scales, opacities, sh0, shN, screen; motion."""
    parameters, camera, around = _problem(given)
    splats, rays, tile_counts, entries, starts = given["frame"]
    means, size, absolute = given["means"], (given["width"], given["height"]), given["screen"].shape[1] == 4
    images: dict[str, Any] = {name: given[name].contiguous() for name in _IMAGES}
    sums = composite_backward(
        launch,
        splats,
        Rays(rays, *half_pixels(*size, splats.device)) if given["exact"] else None,
        entries,
        starts,
        *size,
        len(means),
        around,
        absolute=absolute,
        **images,
    )
    motion = room_for(means, given.get("moving", False))
    frame = Frame(camera, given["sh_degree"], splats, tile_counts, sums, motion)
    out = project_backward(launch, parameters, frame)
    if absolute:
        out["screen"] = torch.cat([out["screen"], out.pop("absolute")], 1)
    found = means.new_empty(0, dtype=torch.float64) if motion is None else motion_sums(launch, motion)
    return *out.values(), found


def bake(launch: Launch, **given: Any) -> tuple[Tensor, ...]:
    """`ops.bake`: images before and behind the own splats, spans, which splats are among, splats and rays.

    Raises:
        RunError: more than 2³¹ pairs of splats and tiles.
    """
    screen = given["means"].new_zeros(len(given["means"]), 2)
    projected, listed, _ = _seen(launch, given | {"exterior": []}, screen)
    settings = (given[name] for name in ("width", "height", "own", "slack", "faint"))
    return *surroundings(launch, projected, listed, *settings), projected.splats, _rays(projected)


def photometric(launch: Launch, **given: Any) -> tuple[Tensor, Tensor, Tensor]:
    """`ops.photometric`."""
    sums, samples, gradient, normal = photometric_sums(launch, **given)
    l1, ssim, squared = (sums / samples).unbind()
    weight = given["lambda_ssim"]
    loss = (1 - weight) * l1 + weight * (1 - ssim)
    normal = sums.new_empty(0, 5) if normal is None else normal
    return torch.stack([loss, l1, ssim, squared]), gradient, normal


def absolute_difference(
    launch: Launch, rendered: Tensor, target: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """`ops.absolute_difference`: the mean over valid pixels, () float64, and its gradient (H, W)."""
    total, samples, gradient = absolute_sum(launch, rendered, target, valid)
    return total / samples, gradient
