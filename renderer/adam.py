"""Adam (Kingma and Ba 2015, algorithm 1): what a step of it moves. The backward pass takes the step."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

BETAS = (0.9, 0.999)  # 3DGS
EPSILON = 1e-15  # 3DGS


class Moving(NamedTuple):
    """One parameter in a step: float32, contiguous, with its moments, which all change in place.

    The definition holds also where a gradient is 0: moments decay, and what they still are moves the value.
    """

    parameter: Tensor  # (N, …)
    exp_avg: Tensor  # (N, …)
    exp_avg_sq: Tensor  # (N, …)
    values: int  # how many of its values move, from the first
    lr: float  # in the parameter's unit
    units: Tensor | None = None  # (N,) what the rate of each row is a multiple of; None: all 1


def check_moving(moving: Mapping[str, Moving], step: int) -> None:
    """Raises ValueError: types or shapes differ, something is not contiguous, a number is out of range."""
    if step < 1:
        raise ValueError(f"step {step} must be at least 1")
    for name, (parameter, *moments, values, _, units) in moving.items():
        tensors = parameter, *moments
        if any(t.dtype != torch.float32 or t.shape != parameter.shape for t in tensors):
            found = [f"{t.dtype} {tuple(t.shape)}" for t in tensors]
            raise ValueError(f"{name} and its moments must be float32 of one shape, not {found}")
        if not all(t.is_contiguous() for t in tensors):
            raise ValueError(f"{name} and its moments change in place: they must be contiguous")
        if units is not None and (units.shape != parameter.shape[:1] or units.dtype != torch.float32):
            found_units = f"{units.dtype} {tuple(units.shape)}"
            rows = f"each of {len(parameter)} rows"
            raise ValueError(f"units of {name} must be float32, one for {rows}, not {found_units}")
        if not 0 <= values <= parameter.numel():
            raise ValueError(f"{values} values of {name} must be within 0 to {parameter.numel()}")
