"""Adam, fused: one pass over parameter, gradient and both moments."""

import torch
from torch import Tensor

from panolog.renderer import ops

BETAS = (0.9, 0.999)  # 3DGS
EPSILON = 1e-15  # 3DGS


def adam_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    rows: int | None = None,
    units: Tensor | None = None,
    betas: tuple[float, float] = BETAS,
    eps: float = EPSILON,
) -> None:
    """One step in place (Kingma and Ba 2015, algorithm 1), on the first `rows` rows only if that is given.

    Args:
        parameter, gradient, exp_avg, exp_avg_sq: (N, …) float32 of one shape, contiguous.
        lr: learning rate in the parameter's unit.
        step: 1 for the first step; the bias correction needs it.
        units: (N,) float32, what the learning rate of each row is a multiple of; None: all 1.
        rows: how many rows take part; the others keep parameter and moments (a frozen sky).

    Raises:
        ValueError: a shape or type differs, something is not contiguous, `step` or `rows` is out of range.
        FloatingPointError: the gradient on the CPU is not finite; parameter and moments are then invalid.
    """
    tensors = parameter, gradient, exp_avg, exp_avg_sq
    if any(t.shape != parameter.shape or t.dtype != torch.float32 for t in tensors):
        found = [f"{t.dtype} {tuple(t.shape)}" for t in tensors]
        raise ValueError(f"parameter, gradient and moments must be float32 of one shape, not {found}")
    if units is not None and (units.shape != parameter.shape[:1] or units.dtype != torch.float32):
        found_units = f"{units.dtype} {tuple(units.shape)}"
        raise ValueError(f"units must be float32, one for each of {len(parameter)} rows, not {found_units}")
    if not all(t.is_contiguous() for t in (parameter, exp_avg, exp_avg_sq)):
        raise ValueError("parameter and moments change in place: they must be contiguous")
    if step < 1 or (rows is not None and not 0 <= rows <= len(parameter)):
        raise ValueError(f"step {step} and rows {rows} must be at least 1 and within 0 to {len(parameter)}")
    count = parameter.numel() if rows is None else parameter[:rows].numel()
    beta1, beta2 = betas
    ops.adam(
        parameter=parameter.detach(),
        gradient=gradient,
        exp_avg=exp_avg,
        exp_avg_sq=exp_avg_sq,
        count=count,
        lr=lr,
        beta1=beta1,
        beta2=beta2,
        eps=eps,
        step=step,
        units=units,
    )
