"""Which cameras train which blocks (eq. 11). Few of all pairs do, so they are sparse arrays."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

OVERLAP = 1.5  # blocks a camera trains on average: estimates assume it, proposed thresholds reach it


@dataclass(frozen=True, eq=False)
class Assignment:
    """Why each of K cameras trains each of B blocks."""

    camera_blocks: NDArray[np.int64]  # (K,) the block that each camera is in, which it trains
    gradient: "scipy.sparse.csr_array"  # (K, B) bool: its gradient score there is close to its best

    def __post_init__(self) -> None:
        blocks, (count, most) = self.camera_blocks, self.gradient.shape
        if blocks.shape != (count,):
            raise ValueError(f"{blocks.shape} camera blocks do not fit scores of shape {(count, most)}")
        if len(blocks) and not (blocks.min() >= 0 and blocks.max() < most):
            raise ValueError(f"camera blocks must be among 0 to {most - 1}, as scores are")
        self.gradient.sort_indices()

    @cached_property
    def assigned(self) -> "scipy.sparse.csr_array":
        """(K, B) bool, sparse: by position or by gradient."""
        count = len(self.camera_blocks)
        own = (np.ones(count, np.bool_), (np.arange(count), self.camera_blocks))
        assigned: scipy.sparse.csr_array = (
            scipy.sparse.csr_array(own, shape=self.gradient.shape) + self.gradient
        )
        assigned.sort_indices()
        return assigned

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """(B,) how many cameras train each block."""
        return np.bincount(self.assigned.indices, minlength=self.assigned.shape[1])

    @cached_property
    def _by_block(self) -> "scipy.sparse.csc_array":
        return self.assigned.tocsc()  # which sorts

    def cameras_of(self, block: int) -> NDArray[np.integer[Any]]:
        """The cameras, 0 to K - 1, that train a block, in order."""
        return _places(self._by_block, block)

    def blocks_of(self, camera: int) -> NDArray[np.integer[Any]]:
        """The blocks that a camera trains, in order."""
        return _places(self.assigned, camera)

    def by_gradient(self, camera: int) -> NDArray[np.integer[Any]]:
        """The blocks that a camera trains because of its gradient scores, in order."""
        return _places(self.gradient, camera)

    @property
    def overlap(self) -> float:
        """How many blocks a camera trains on average; 0 without cameras."""
        return float(self.assigned.nnz / max(len(self.camera_blocks), 1))

    @property
    def added(self) -> int:
        """How many assignments gradients add to those by position."""
        return int(self.assigned.nnz - len(self.camera_blocks))


def assign(
    camera_blocks: ArrayLike, scores: "ArrayLike | scipy.sparse.csr_array", tau_grad: float
) -> Assignment:
    """Camera-block assignment by position or by gradient ratio (eq. 11).

    A ratio equal to tau_grad does not count. A camera with only zero scores gets its geometric block alone.

    Args: camera_blocks (K,) the block that each camera is in; scores (K, B) of eq. 10, not negative, may be
    sparse; tau_grad the threshold τ_grad.
    Raises ValueError on shapes that disagree, scores negative or not finite.
    """
    values = scipy.sparse.csr_array(scores, dtype=np.float64)
    if not (np.isfinite(values.data) & (values.data >= 0.0)).all():
        raise ValueError("gradient scores must be finite and not negative")
    cameras = np.repeat(np.arange(values.shape[0]), np.diff(values.indptr))
    best = np.zeros(values.shape[0])
    np.maximum.at(best, cameras, values.data)
    of_best = best[cameras]
    chosen = np.divide(values.data, of_best, out=np.zeros_like(of_best), where=of_best > 0.0) > tau_grad
    pairs = (cameras[chosen], values.indices[chosen])
    gradient = scipy.sparse.csr_array((np.ones(len(pairs[0]), np.bool_), pairs), shape=values.shape)
    return Assignment(np.asarray(camera_blocks, np.int64), gradient)


def overlap(
    camera_blocks: ArrayLike, scores: "ArrayLike | scipy.sparse.csr_array", taus: Iterable[float]
) -> NDArray[np.float64]:
    """(T,) how many blocks a camera trains on average at each of T thresholds τ_grad.

    Args and errors as `assign`. 0 without cameras.
    """
    return np.array([assign(camera_blocks, scores, tau).overlap for tau in taus])


def _places(
    pairs: "scipy.sparse.csr_array | scipy.sparse.csc_array", number: int
) -> NDArray[np.integer[Any]]:
    """Where a row of sparse rows, or a column of sparse columns, has values."""
    start, stop = pairs.indptr[number : number + 2]
    places: NDArray[np.integer[Any]] = pairs.indices[start:stop]
    return places
