"""How far positions of panoramas are from the true ones."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def length(centers: Array) -> float:
    """Length of the path through positions (K, 3) in their order."""
    return float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())


def drift(found: Array, truth: Array) -> float:
    """Root mean square distance of positions (K, 3) from the true ones, after the best similarity.

    The similarity minimises the squared distances (Umeyama, 1991).
    """
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    left, sizes, right = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = (sizes * np.diag(sign)).sum() / (a**2).sum()
    moved = scale * a @ (left @ sign @ right).T
    return float(np.sqrt(((moved - b) ** 2).sum(axis=1).mean()))
