"""Adam, fused: one pass over parameter, gradient and both moments."""

from torch import Tensor

from panolog.renderer import ops


def adam_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    rows: int | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> None:
    """One step in place (Kingma and Ba 2015, algorithm 1), on the first `rows` rows only if that is given.

    Args:
        parameter, gradient, exp_avg, exp_avg_sq: (N, …) float32 of one shape, contiguous.
        lr: learning rate in the parameter's unit.
        step: 1 for the first step; the bias correction needs it.
        rows: how many rows take part; the others keep parameter and moments (a frozen sky).

    Raises:
        ValueError: a shape differs, or the parameter is not contiguous.
    """
    shapes = {tuple(tensor.shape) for tensor in (parameter, gradient, exp_avg, exp_avg_sq)}
    if len(shapes) > 1 or not (
        parameter.is_contiguous() and exp_avg.is_contiguous() and exp_avg_sq.is_contiguous()
    ):
        raise ValueError(f"parameter, gradient and moments must be contiguous and of one shape, not {shapes}")
    count = parameter.numel()
    if rows is not None:
        count = count // max(1, len(parameter)) * rows
    ops.adam(parameter.detach(), gradient, exp_avg, exp_avg_sq, count, lr, *betas, eps, step)
