"""The kernels as torch custom ops: torch's dispatcher selects the device, autograd the backward pass."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.renderer import _core
from panolog.renderer.cuda.parts import Launch
from panolog.renderer.motion import MOTION_SUMS

HIDDEN, VISIBLE, INVALID = 0, 1, 2  # State in csrc/formulas.h

_NAMES: dict[str, tuple[str, ...]] = {}  # of the arguments, by op
_LIBRARY: Any = torch.library.Library("panolog", "DEF")  # type: ignore[no-untyped-call]


def _op(function: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel of the CPU as an op of the same name and signature; on CUDA it is that of `cuda.card`.

    `torch.library.custom_op` would import torch's compiler at the first call: 100 MB and 2 s of each worker.
    """
    name = function.__name__
    _LIBRARY.define(name + torch.library.infer_schema(function, mutates_args=()))
    _LIBRARY.impl(name, function, "CPU")
    _NAMES[name] = tuple(signature(function).parameters)
    _LIBRARY.impl(name, partial(_on_gpu, name), "CUDA")
    op: Callable[..., Any] = getattr(torch.ops.panolog, name).default
    return op


def named(op: str, arguments: Sequence[Any]) -> dict[str, Any]:
    """The arguments that torch's dispatcher passes to an op, by their names."""
    return dict(zip(_NAMES[op], arguments, strict=False))


def _on_gpu(op: str, *arguments: Any) -> Any:
    return card_module().run(op, named(op, arguments))


_threads: int | None = None


def use_threads(count: int | None) -> None:
    """Sets the number of threads of the CPU kernels; None: as many as torch has."""
    global _threads  # noqa: PLW0603  # of the process, as torch's is
    _threads = count


def threads() -> int:
    """How many threads the CPU kernels use."""
    return _threads or torch.get_num_threads()


def _array(tensor: Tensor) -> NDArray[Any]:
    """A tensor as the kernels take it. Its type stays: kernels write to some of their arguments."""
    if tensor.dtype not in (torch.float32, torch.uint8, torch.int32):
        raise TypeError(f"the kernels work on float32, uint8 and int32, not on {tensor.dtype}")
    return tensor.detach().contiguous().numpy()


def _arrays(**tensors: Tensor) -> dict[str, NDArray[Any]]:
    """Arguments of a kernel by their names."""
    return {name: _array(tensor) for name, tensor in tensors.items()}


def _exterior(tensors: list[Tensor]) -> Any:
    """An exterior as the kernels take it."""
    return tuple(map(_array, tensors)) if tensors else None


@_op
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
    exact: bool,
    exterior: list[Tensor],
    motion: Tensor | None = None,  # noqa: ARG001  # receives a gradient, as `screen` does
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Eq. 1 for N Gaussians; shapes as in `renderer.render.render`.

    Args: exterior, `baked.Baked.arrays` or none; motion, see `renderer.render.render`.

    Returns color (H, W, 3), alpha (H, W), inverse depth (H, W), state (N,) uint8, and what the backward
    pass needs: splats (16 (N + M),) with the M of the exterior, rays likewise or, without `exact`, (0,),
    slots (N + 1,), entries (3 E,), tiles (T + 1,).
    """
    color = torch.empty((height, width, 3))
    alpha, inverse_depth = torch.empty((height, width)), torch.empty((height, width))
    state = torch.empty(len(means), dtype=torch.uint8)
    splats, rays, slots, entries, tiles = _core.rasterize(
        **_arrays(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN),
        **_arrays(screen=screen[:, :2], rotation=rotation, translation=translation),
        width=width,
        height=height,
        sh_degree=sh_degree,
        near=near,
        exact=exact,
        threads=threads(),
        **_arrays(color=color, alpha=alpha, inverse_depth=inverse_depth, state=state),
        exterior=_exterior(exterior),
    )
    frame = [torch.from_numpy(array) for array in (splats, rays, slots, entries, tiles)]
    return color, alpha, inverse_depth, state, frame[0], frame[1], frame[2], frame[3], frame[4]


@_op
def rasterize_backward(
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
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The gradients of means, quats, scales, opacities, sh0, shN and screen, from those of the three images.

    That of a screen (N, 4) ends with the absolute gradients (`renderer.render.render`).

    Args: those of `rasterize`, its images, and `frame`, the last five tensors that it returned; moving,
    whether the last result holds the sums of the camera's motion, (27,) float64, or is empty.
    """
    parameters = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    parameters |= {"sh0": sh0, "shN": shN}
    found = [torch.empty(parameter.shape) for parameter in parameters.values()]
    by_screen, absolute = torch.empty(len(screen), 2), torch.empty(len(screen), screen.shape[1] - 2)
    motion = torch.empty(MOTION_SUMS if moving else 0, dtype=torch.float64)
    backward_into(
        {
            **parameters,
            **{"screen": screen, "rotation": rotation, "translation": translation, "width": width},
            **{"height": height, "sh_degree": sh_degree, "near": near, "exact": exact, "exterior": exterior},
            **{"color": color, "alpha": alpha, "inverse_depth": inverse_depth, "grad_color": grad_color},
            **{"grad_alpha": grad_alpha, "grad_inverse_depth": grad_inverse_depth},
        },
        frame,
        out=tuple(map(_array, found)),
        out_screen=by_screen.numpy(),
        out_motion=motion.numpy() if moving else None,
        out_absolute=absolute.numpy() if absolute.shape[1] else None,
    )
    means, quats, scales, opacities, sh0, shN = found
    return means, quats, scales, opacities, sh0, shN, torch.cat([by_screen, absolute], 1), motion


def backward_into(given: Mapping[str, Any], frame: Sequence[Tensor], **results: Any) -> int:
    """The kernel of the backward pass on the CPU, as `_core.rasterize_backward` has it.

    Args: given, what `rasterize_backward` takes, but for `frame` and `moving`; results, where gradients go,
    or the step that they take. Returns a bit for each parameter that should move by what is not finite.
    """
    tensors = {name: value for name, value in given.items() if isinstance(value, Tensor)}
    numbers = {name: value for name, value in given.items() if name not in tensors}
    tensors |= {"screen": given["screen"][:, :2], **dict(zip(_FRAME, frame, strict=True))}
    around = _exterior(numbers.pop("exterior"))
    arguments: dict[str, Any] = {**_arrays(**tensors), **numbers, **results}
    return _core.rasterize_backward(**arguments, exterior=around, threads=threads())


@_op
def bake(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    rotation: Tensor,
    translation: Tensor,
    own: int,
    width: int,
    height: int,
    sh_degree: int,
    near: float,
    exact: bool,
    slack: float,
    faint: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What a camera sees of all but the first `own` of N Gaussians, before and behind those (csrc/bake.h).

    Returns color (H, W, 3), alpha (H, W) and inverse depth (H, W) of what is before, then of what is behind;
    spans (T, 2); among (N,) uint8, which splats composite among the own ones; splats (16 N,) and rays
    likewise or, without `exact`, (0,). Images are undefined in tiles whose span is empty.
    """
    images = [torch.zeros(shape) for shape in ((height, width, 3), (height, width), (height, width)) * 2]
    names = (f"{layer}_{image}" for layer in ("front", "back") for image in _IMAGES)
    found = _core.bake(
        **_arrays(means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN),
        **_arrays(screen=torch.zeros(len(means), 2), rotation=rotation, translation=translation),
        own=own,
        width=width,
        height=height,
        sh_degree=sh_degree,
        near=near,
        exact=exact,
        slack=slack,
        faint=faint,
        threads=threads(),
        **_arrays(**dict(zip(names, images, strict=True))),
    )
    spans, among, splats, rays = (torch.from_numpy(array) for array in found)
    front, front_alpha, front_depth, back, back_alpha, back_depth = images
    return (
        *(front, front_alpha, front_depth, back, back_alpha, back_depth),
        *(spans.view(-1, 2), among, splats, rays),
    )


_TENSORS = ("means", "quats", "scales", "opacities", "sh0", "shN", "screen", "rotation", "translation")
_SETTINGS = ("width", "height", "sh_degree", "near", "exact")
_EXTERIOR = "exterior"
_IMAGES = ("color", "alpha", "inverse_depth")
_FRAME = ("splats", "rays", "slots", "entries", "tiles")  # what `rasterize` returns last


def _save(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    given = dict(zip((*_TENSORS, *_SETTINGS, _EXTERIOR, "motion"), inputs, strict=False))
    color, alpha, inverse_depth, state, *frame = output
    ctx.settings = {name: given[name] for name in (*_SETTINGS, _EXTERIOR)}
    ctx.settings["moving"] = given.get("motion") is not None
    ctx.mark_non_differentiable(state, *frame)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*(given[name] for name in _TENSORS), color, alpha, inverse_depth, *frame)


def _backward(ctx, color, alpha, inverse_depth, *_frame):  # type: ignore[no-untyped-def]
    names = (*_TENSORS, *_IMAGES)
    saved = dict(zip(names, ctx.saved_tensors, strict=False))
    gradients = {
        f"grad_{name}": torch.zeros_like(saved[name]) if gradient is None else gradient
        for name, gradient in zip(_IMAGES, (color, alpha, inverse_depth), strict=True)
    }
    frame = list(ctx.saved_tensors[len(names) :])
    *found, motion = rasterize_backward(**saved, **ctx.settings, frame=frame, **gradients)
    others = 2 + len(_SETTINGS)  # rotation and translation
    exterior = [None] * len(ctx.settings[_EXTERIOR])
    last = [motion] if ctx.settings["moving"] else []  # an argument that is not given is none of the inputs
    return (*found, *[None] * others, exterior, *last)


def _differentiable(op: str, backward: Callable[..., Any], save: Callable[..., None]) -> None:
    torch.library.register_autograd(f"panolog::{op}", backward, setup_context=save, lib=_LIBRARY)


_differentiable("rasterize", _backward, _save)


@_op
def photometric(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    lambda_ssim: float,
    rows: Tensor | None = None,
    exposure: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns (4,) float64: loss, L1, SSIM, mean squared error; the loss's gradient (H, W, 3); exposure sums.

    Args: rows (H,) float32, weights of the rows in L1 and SSIM; exposure (2, 3) float32, factors and summands
    of the colours. Its sums are (3, 5) float64, ExposureSums in csrc/kernels.h by channel; (0, 5) without it.
    """
    height, width, _ = color.shape
    gradient, normal = torch.empty((height, width, 3)), torch.empty((0, 5), dtype=torch.float64)
    optional: dict[str, NDArray[Any]] = {} if rows is None else _arrays(rows=rows)
    if exposure is not None:
        normal = torch.empty((3, 5), dtype=torch.float64)
        optional |= {"exposure": _array(exposure), "normal": normal.numpy()}
    l1, ssim, squared = _core.photometric(
        **_arrays(color=color, target=target, gradient=gradient),
        mask=None if mask is None else _array(mask.view(torch.uint8)),
        width=width,
        height=height,
        lambda_ssim=lambda_ssim,
        threads=threads(),
        **optional,
    )
    loss = (1 - lambda_ssim) * l1 + lambda_ssim * (1 - ssim)
    return torch.tensor([loss, l1, ssim, squared], dtype=torch.float64), gradient, normal


@_op
def absolute_difference(rendered: Tensor, target: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the mean over valid pixels, () float64, and its gradient (H, W)."""
    gradient = torch.empty_like(rendered, memory_format=torch.contiguous_format)
    mean = _core.absolute_difference(
        **_arrays(rendered=rendered, target=target, valid=valid.view(torch.uint8), gradient=gradient),
        threads=threads(),
    )
    return torch.tensor(mean, dtype=torch.float64), gradient


def _save_gradient(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.inputs = len(inputs)
    ctx.mark_non_differentiable(*output[1:])
    ctx.save_for_backward(output[1])


def _scale_gradient(ctx, value, *_others):  # type: ignore[no-untyped-def]
    (gradient,) = ctx.saved_tensors
    # the first value is the loss; the others have no gradient
    return (gradient * value.flatten()[0].to(gradient.dtype), *[None] * (ctx.inputs - 1))


_differentiable("photometric", _scale_gradient, _save_gradient)
_differentiable("absolute_difference", _scale_gradient, _save_gradient)


def launcher(device: torch.device) -> Launch | None:
    """How kernels are launched on a GPU, which becomes torch's current one; None for the CPU.

    Raises DeviceError if the GPU or its driver is too old, or if cuda-core or NVRTC is missing.
    """
    if device.type != "cuda":
        return None
    index = torch.cuda.current_device() if device.index is None else device.index
    card = card_module().Card.of(index)
    torch.cuda.set_device(card.torch_device)
    launch: Launch = card.launch
    return launch


def card_module() -> Any:
    """`renderer.cuda.card`, imported when it is first used: without a GPU its dependencies may be missing.

    Raises DeviceError with the name of what is missing.
    """
    from panolog.renderer.cuda import nvrtc  # noqa: PLC0415

    nvrtc.nvrtc_version()  # names the missing package; the next import could not
    from panolog.renderer.cuda import card  # noqa: PLC0415

    return card
