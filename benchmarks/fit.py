"""Straight lines through measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fit:
    """value = constant + Σ slope · column, by least squares."""

    constant: float
    slopes: dict[str, float]  # by column
    r2: float  # coefficient of determination, 1 where the line meets every value

    def __call__(self, **columns: float) -> float:
        """The value on the line."""
        return self.constant + sum(self.slopes[name] * value for name, value in columns.items())


def fit(columns: Mapping[str, Sequence[float]], values: Sequence[float]) -> Fit:
    """Args: columns, each as long as `values`."""
    design = np.column_stack([np.ones(len(values)), *(np.asarray(column) for column in columns.values())])
    target = np.asarray(values, float)
    scale = np.abs(design).max(
        0
    )  # columns of one size: pixels and a constant in one matrix are badly conditioned
    found = np.linalg.lstsq(design / scale, target, rcond=None)[0] / scale
    residual = target - design @ found
    spread = target - target.mean()
    r2 = 1 - float(residual @ residual) / float(spread @ spread)
    return Fit(float(found[0]), dict(zip(columns, map(float, found[1:]), strict=True)), r2)
