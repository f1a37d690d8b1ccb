"""Which cameras train which blocks (eq. 11)."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

OVERLAP = 1.5  # blocks a camera trains on average: estimates assume it, proposed thresholds reach it


@dataclass(frozen=True, eq=False)
class Assignment:
    """Why each of K cameras trains each of B blocks."""

    geometric: NDArray[np.bool_]  # (K, B) the camera is in the block
    gradient: NDArray[np.bool_]  # (K, B) its gradient score there is close to its best

    @cached_property
    def assigned(self) -> NDArray[np.bool_]:
        """(K, B) for either reason."""
        return self.geometric | self.gradient


def assign(camera_blocks: ArrayLike, scores: ArrayLike, tau_grad: float) -> Assignment:
    """Camera-block assignment by position or by gradient ratio (eq. 11).

    A ratio equal to tau_grad does not count. A camera with only zero scores gets its geometric block alone.

    Args: camera_blocks (K,) the block that each camera is in; scores (K, B) of eq. 10, not negative;
    tau_grad the threshold τ_grad. Raises ValueError on shapes that disagree, scores negative or not finite.
    """
    blocks = np.asarray(camera_blocks)
    values = np.asarray(scores, np.float64)
    if values.ndim != 2 or blocks.shape != values.shape[:1]:
        raise ValueError(f"{blocks.shape} camera blocks do not fit scores of shape {values.shape}")
    if not (np.isfinite(values) & (values >= 0.0)).all():
        raise ValueError("gradient scores must be finite and not negative")
    if len(blocks) and not (blocks.min() >= 0 and blocks.max() < values.shape[1]):
        raise ValueError(f"camera blocks must be among 0 to {values.shape[1] - 1}")
    best = values.max(axis=1, keepdims=True)
    ratio = np.divide(values, best, out=np.zeros_like(values), where=best > 0.0)
    return Assignment(blocks[:, None] == np.arange(values.shape[1]), ratio > tau_grad)


def overlap(camera_blocks: ArrayLike, scores: ArrayLike, taus: Iterable[float]) -> NDArray[np.float64]:
    """(T,) how many blocks a camera trains on average at each of T thresholds τ_grad.

    Args and errors as `assign`. 0 without cameras.
    """
    cameras = max(len(np.asarray(camera_blocks)), 1)
    return np.array([assign(camera_blocks, scores, tau).assigned.sum() / cameras for tau in taus])
