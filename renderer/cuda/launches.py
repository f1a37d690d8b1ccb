"""The ops on CUDA: for each a sequence of kernels and torch operations, in memory of torch.

A sequence launches kernels through a `Launch` and does not depend on the card. On a GPU that is
`card.Card.launch`, in the tests an emulation on the host.
"""

import math
import struct
from typing import Protocol

import torch
from torch import Tensor

from panolog.scene.errors import RunError

TILE = 16  # kTile in csrc/cuda/common.cuh
SPAN = 128  # Gaussians in a block of project.cu
THREADS = 256  # in a block of all other kernels
LANES = 8  # threads that share a splat in bin.cu
SPLAT_FLOATS = 16  # sizeof(Splat) / 4 in csrc/formulas.h
GRADIENT_FLOATS = 10  # kGradientFloats in csrc/formulas.h
MAX_PAIRS = 2**31 - 1  # of splats and tiles, counted in int32
NARROW_TILES = 2**15  # below so many their numbers fit int16, which sorts in half the time

Argument = Tensor | int | float | bytes | None


class Launch(Protocol):
    """Launches kernels of csrc/cuda on one device."""

    def __call__(self, kernel: str, grid: tuple[int, int], block: int, /, **arguments: Argument) -> None:
        """Run a kernel on grid[0] × grid[1] blocks of `block` threads; not at all if there is no block.

        Arguments go by the names of the kernel's parameters. Tensors become pointers to their first element,
        None a null pointer, int int64_t, float float, and bytes a struct by value.
        """


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
) -> tuple[Tensor, ...]:
    """`ops.rasterize`: color, alpha, inverse depth, state and the frame for the backward pass.

    The frame is splats (16 N,), the number of tiles that each meets (N,) int32, the rows of the splats of
    each tile (E,) int32, nearest first, and the index at which those of each tile start (T + 1,) int32.

    Raises:
        RunError: more than 2³¹ pairs of splats and tiles.
    """
    count = len(means)
    splats, depth = means.new_empty(count * SPLAT_FLOATS), means.new_empty(count)
    state = means.new_empty(count, dtype=torch.uint8)
    tile_counts = means.new_empty(count, dtype=torch.int32)
    launch(
        "project_forward",
        (math.ceil(count / SPAN), 1),
        SPAN,
        **_contiguous(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN),
        screen=screen.contiguous(),
        camera=_camera(rotation, translation, width, height, near),
        sh_count=(sh_degree + 1) ** 2,
        count=count,
        splats=splats,
        state=state,
        depth=depth,
        tile_counts=tile_counts,
    )
    entries, starts = _bin(launch, splats, depth, tile_counts, width, height)

    color, alpha = means.new_empty(height, width, 3), means.new_empty(height, width)
    inverse_depth = torch.empty_like(alpha)
    launch(
        "composite_forward",
        _tiles(width, height),
        THREADS,
        splats=splats,
        entries=entries,
        starts=starts,
        width=width,
        height=height,
        color=color,
        alpha=alpha,
        inverse_depth=inverse_depth,
    )
    return color, alpha, inverse_depth, state, splats, tile_counts, entries, starts


def _bin(
    launch: Launch, splats: Tensor, depth: Tensor, tile_counts: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Rows of the splats by tile, nearest first within it (E,), and where each tile's begin (T + 1,).

    Sorted by depth first, then stably by tile: neither sort needs keys of 64 bits.
    """
    count = len(depth)
    order = torch.sort(depth, stable=True).indices
    ends = torch.cumsum(tile_counts[order], 0)
    pairs = int(ends[-1]) if count else 0
    if pairs > MAX_PAIRS:
        raise RunError(f"{pairs} pairs of Gaussians and tiles are too many: render fewer Gaussians or pixels")
    across, down = _tiles(width, height)
    narrow = across * down < NARROW_TILES
    tiles = tile_counts.new_empty(pairs, dtype=torch.int16 if narrow else torch.int32)
    rows = tile_counts.new_empty(pairs)
    launch(
        "bin_narrow" if narrow else "bin_wide",
        (math.ceil(count * LANES / THREADS), 1),
        THREADS,
        splats=splats,
        order=order,
        ends=ends,
        tile_counts=tile_counts,
        count=count,
        width=width,
        height=height,
        tiles=tiles,
        rows=rows,
    )
    tiles, by_tile = torch.sort(tiles, stable=True)
    numbers = torch.arange(across * down, dtype=tiles.dtype, device=tiles.device)
    starts = torch.searchsorted(tiles, numbers, out_int32=True)
    return rows[by_tile], torch.cat([starts, starts.new_full((1,), pairs)])


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
    color: Tensor,
    alpha: Tensor,
    inverse_depth: Tensor,
    frame: list[Tensor],
    grad_color: Tensor,
    grad_alpha: Tensor,
    grad_inverse_depth: Tensor,
) -> tuple[Tensor, ...]:
    """`ops.rasterize_backward`: the gradients of means, quats, scales, opacities, sh0, shN and screen."""
    splats, tile_counts, entries, starts = frame
    count = len(means)
    sums = splats.new_zeros(count, GRADIENT_FLOATS)
    launch(
        "composite_backward",
        _tiles(width, height),
        THREADS,
        splats=splats,
        entries=entries,
        starts=starts,
        width=width,
        height=height,
        **_contiguous(color=color, alpha=alpha, inverse_depth=inverse_depth, grad_color=grad_color),
        **_contiguous(grad_alpha=grad_alpha, grad_inverse_depth=grad_inverse_depth),
        sums=sums,
    )
    parameters = _contiguous(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN)
    out = {name: torch.empty_like(tensor) for name, tensor in (parameters | {"screen": screen}).items()}
    launch(
        "project_backward",
        (math.ceil(count / SPAN), 1),
        SPAN,
        **parameters,
        camera=_camera(rotation, translation, width, height, near),
        sh_count=(sh_degree + 1) ** 2,
        count=count,
        splats=splats,
        tile_counts=tile_counts,
        sums=sums,
        **{f"out_{name}": tensor for name, tensor in out.items()},
    )
    return tuple(out.values())


def photometric(
    launch: Launch, color: Tensor, target: Tensor, mask: Tensor | None, lambda_ssim: float
) -> tuple[Tensor, Tensor]:
    """`ops.photometric`: (4,) float64 loss, L1, SSIM, squared error; and the loss's gradient (H, W, 3)."""
    height, width, _ = color.shape
    color, target = color.contiguous(), target.contiguous()
    used = None if mask is None else mask.contiguous().view(torch.uint8)
    # computed on the device: the host does not wait for it
    whole = color.new_full((), width * height, dtype=torch.float64)
    count = 3 * (whole if mask is None else mask.sum().double()).clamp(min=1)
    grid = _tiles(width, height)
    by = color.new_empty(3, *color.shape)
    partials = color.new_empty(grid[0] * grid[1], 3, dtype=torch.float64)
    gradient = torch.empty_like(color)
    problem: dict[str, Argument] = {
        "color": color,
        "target": target,
        "mask": used,
        "width": width,
        "height": height,
        "lambda_ssim": lambda_ssim,
        "count": count,
        "by": by,
    }
    launch("loss_similarity", grid, THREADS, **problem, partials=partials)
    launch("loss_gradient", grid, THREADS, **problem, gradient=gradient)
    l1, ssim, squared = (partials.sum(0) / count).unbind()
    loss = (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim)
    return torch.stack([loss, l1, ssim, squared]), gradient


def absolute_difference(
    launch: Launch, rendered: Tensor, target: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """`ops.absolute_difference`: the mean over valid pixels, () float64, and its gradient (H, W)."""
    pixels = rendered.numel()
    count = valid.sum().double().clamp(min=1)
    blocks = math.ceil(pixels / THREADS)
    partials = rendered.new_empty(blocks, dtype=torch.float64)
    gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
    launch(
        "loss_absolute",
        (blocks, 1),
        THREADS,
        **_contiguous(rendered=rendered, target=target, valid=valid.view(torch.uint8)),
        pixels=pixels,
        count=count,
        gradient=gradient,
        partials=partials,
    )
    return partials.sum() / count, gradient


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
) -> None:
    """`ops.adam`: one step on the first `count` values, in place."""
    launch(
        "adam_step",
        (math.ceil(count / THREADS), 1),
        THREADS,
        count=count,
        rate=lr / (1 - beta1**step),
        root=1 / math.sqrt(1 - beta2**step),
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        gradient=gradient.contiguous(),
        parameter=parameter,
        exp_avg=exp_avg,
        exp_avg_sq=exp_avg_sq,
    )


def _camera(rotation: Tensor, translation: Tensor, width: int, height: int, near: float) -> bytes:
    """`Camera` of csrc/formulas.h. The host waits for a pose that is on the card."""
    pose = b"".join(tensor.detach().cpu().numpy().tobytes() for tensor in (rotation, translation))
    return pose + struct.pack("=iif", width, height, near)


def _contiguous(**tensors: Tensor) -> dict[str, Tensor]:
    return {name: tensor.contiguous() for name, tensor in tensors.items()}


def _tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down."""
    return math.ceil(width / TILE), math.ceil(height / TILE)
