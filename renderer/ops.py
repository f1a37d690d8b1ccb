"""The kernels as torch custom ops: torch's dispatcher picks the device, autograd the way back."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from panolog.renderer import _core

HIDDEN, VISIBLE, INVALID = 0, 1, 2  # State in csrc/formulas.h
SPLAT_FLOATS = 16  # sizeof(Splat) / 4 in csrc/formulas.h


def threads() -> int:
    """How many threads the CPU kernels use: as many as torch does, so that one setting rules both."""
    return torch.get_num_threads()


def _arrays(*tensors: Tensor) -> list[object]:
    """As the kernels take them; a conversion to another type would hide what they write."""
    for tensor in tensors:
        if tensor.dtype not in (torch.float32, torch.uint8, torch.int32):
            raise TypeError(f"the kernels work on float32, uint8 and int32, not on {tensor.dtype}")
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


@torch.library.custom_op("panolog::rasterize", mutates_args=(), device_types="cpu")
def rasterize(
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
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Eq. 1 for N Gaussians; shapes as in `renderer.render.render`.

    Returns color (H, W, 3), alpha (H, W), inverse depth (H, W), state (N,) uint8, and what the backward
    pass needs: splats (16 N,), slots (N + 1,), entries (3 E,), tiles (T + 1,).
    """
    color = torch.empty((height, width, 3))
    alpha, inverse_depth = torch.empty((height, width)), torch.empty((height, width))
    state = torch.empty(len(means), dtype=torch.uint8)
    splats, slots, entries, tiles = _core.rasterize(
        *_arrays(means, quats, scales, opacities, sh0, shN, screen, rotation, translation),
        width,
        height,
        sh_degree,
        near,
        threads(),
        *_arrays(color, alpha, inverse_depth, state),
    )
    frame = [torch.from_numpy(array) for array in (splats, slots, entries, tiles)]
    return color, alpha, inverse_depth, state, frame[0], frame[1], frame[2], frame[3]


@torch.library.custom_op("panolog::rasterize_backward", mutates_args=(), device_types="cpu")
def rasterize_backward(
    parameters: list[Tensor],
    pose: list[Tensor],
    width: int,
    height: int,
    sh_degree: int,
    near: float,
    images: list[Tensor],
    frame: list[Tensor],
    gradients: list[Tensor],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The gradients of the seven `parameters`, from those of the three `images`."""
    out = [torch.empty_like(parameter, memory_format=torch.contiguous_format) for parameter in parameters]
    _core.rasterize_backward(
        *_arrays(*parameters, *pose),
        width,
        height,
        sh_degree,
        near,
        threads(),
        *_arrays(*images, *frame, *gradients),
        *_arrays(*out),
    )
    means, quats, scales, opacities, sh0, shN, screen = out
    return means, quats, scales, opacities, sh0, shN, screen


def _save(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    *tensors, width, height, sh_degree, near = inputs
    color, alpha, inverse_depth, state, *frame = output
    ctx.settings = (width, height, sh_degree, near)
    ctx.mark_non_differentiable(state, *frame)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors, color, alpha, inverse_depth, *frame)


def _backward(ctx, color, alpha, inverse_depth, *_frame):  # type: ignore[no-untyped-def]
    saved = ctx.saved_tensors
    images = saved[9:12]
    gradients = [
        torch.zeros_like(image) if gradient is None else gradient
        for image, gradient in zip(images, (color, alpha, inverse_depth), strict=True)
    ]
    found = rasterize_backward(
        list(saved[:7]), list(saved[7:9]), *ctx.settings, list(images), list(saved[12:]), gradients
    )
    return (*found, *[None] * 6)


rasterize.register_autograd(_backward, setup_context=_save)


@torch.library.custom_op("panolog::photometric", mutates_args=(), device_types="cpu")
def photometric(
    color: Tensor, target: Tensor, mask: Tensor | None, lambda_ssim: float
) -> tuple[Tensor, Tensor]:
    """Returns (4,) float64: loss, L1, SSIM, mean squared error; and the loss's gradient (H, W, 3)."""
    height, width, _ = color.shape
    gradient = torch.empty((height, width, 3))
    l1, ssim, squared = _core.photometric(
        *_arrays(color, target),
        None if mask is None else mask.contiguous().view(torch.uint8).numpy(),
        width,
        height,
        lambda_ssim,
        threads(),
        *_arrays(gradient),
    )
    loss = (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim)
    return torch.tensor([loss, l1, ssim, squared], dtype=torch.float64), gradient


@torch.library.custom_op("panolog::absolute_difference", mutates_args=(), device_types="cpu")
def absolute_difference(rendered: Tensor, target: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the mean over valid pixels, () float64, and its gradient (H, W)."""
    gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
    mean = _core.absolute_difference(
        *_arrays(rendered, target, valid.view(torch.uint8)), threads(), *_arrays(gradient)
    )
    return torch.tensor(mean, dtype=torch.float64), gradient


def _save_gradient(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.inputs = len(inputs)
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(output[1])


def _scale_gradient(ctx, value, _gradient):  # type: ignore[no-untyped-def]
    (gradient,) = ctx.saved_tensors
    # the loss is the first value; what comes with it is only reported
    return (gradient * value.flatten()[0].to(gradient.dtype), *[None] * (ctx.inputs - 1))


photometric.register_autograd(_scale_gradient, setup_context=_save_gradient)
absolute_difference.register_autograd(_scale_gradient, setup_context=_save_gradient)


@torch.library.custom_op(
    "panolog::adam", mutates_args=("parameter", "exp_avg", "exp_avg_sq"), device_types="cpu"
)
def adam(
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
    """One step of Adam (Kingma and Ba 2015, algorithm 1) on the first `count` values, in place."""
    _core.adam(
        *_arrays(parameter, gradient, exp_avg, exp_avg_sq), count, lr, beta1, beta2, eps, step, threads()
    )


def _on_gpu(op: str) -> Callable[..., Any]:
    """An op on CUDA. It is imported when first called: without a GPU what it needs may be missing."""

    def call(*arguments: Any) -> Any:
        from panolog.renderer import cuda_compile  # noqa: PLC0415

        cuda_compile.nvrtc_version()  # says what is missing, where the next import could only fail
        from panolog.renderer import cuda_device  # noqa: PLC0415

        return cuda_device.run(op, *arguments)

    return call


rasterize.register_kernel("cuda")(_on_gpu("rasterize"))
rasterize_backward.register_kernel("cuda")(_on_gpu("rasterize_backward"))
photometric.register_kernel("cuda")(_on_gpu("photometric"))
absolute_difference.register_kernel("cuda")(_on_gpu("absolute_difference"))
adam.register_kernel("cuda")(_on_gpu("adam"))
