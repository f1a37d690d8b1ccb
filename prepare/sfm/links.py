"""How firmly the parts of a reconstruction are connected: where its scale may jump.

The scale on one side of a cut between panoramas is carried to the other by the points that two or more
panoramas of each side see. From rays alone, a side knows the distance of such a point to a relative variance
of 1 / I, with the information I = sum |c_perp|^2 / (d sigma)^2 over its panoramas: c_perp is the part of a
camera centre's offset from the side's mean that is perpendicular to the ray, d the distance, sigma the
angular error. The ratio of the two sides' scales then has the variance 1 / sum_p 1 / (1 / I_a + 1 / I_b)
(inverse-variance weighting). Poses within a side count as exact, so it is a lower bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from panolog.prepare.sfm.sparse_model import SparseModel

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
_MOST_CUTS = 48  # evaluated: each takes a pass over all observations


@dataclass(frozen=True)
class Link:
    """Two parts of a reconstruction and what connects them."""

    between: tuple[int, int]  # rows of the two panoramas, one in each part, that share most
    smaller: tuple[int, ...]  # rows of the smaller part
    points: int  # seen by two or more panoramas of both parts
    scale_error: float  # relative standard deviation of the scale across, at least; inf without such points


def links_of(model: SparseModel, width: int) -> list[Link]:
    """Between parts of a model of panoramas of that width in pixels, the weakest first."""
    sigma = float(np.median(np.concatenate(model.errors(width)))) * 2 * np.pi / width
    return find_links(model.centers, model.points, [rows for rows, _ in model.sightings], sigma)


def find_links(centers: Array, points: Array, seen: Sequence[Rows], sigma: float) -> list[Link]:
    """Cuts along the strongest tree of panoramas that share points, the weakest first.

    Of many panoramas, the edges that share least are evaluated. A single panorama has no scale, so a cut
    leaves two or more on each side.

    Args: centers (K, 3); points (P, 3); seen, for each panorama the rows of points it sees; sigma, the
    angular error of an observation in radians.
    """
    cameras = np.repeat(np.arange(len(seen)), [len(rows) for rows in seen])
    rows = np.concatenate([np.empty(0, np.int64), *seen])
    table = csr_array((np.ones(len(rows)), (cameras, rows)), shape=(len(seen), len(points)))
    shared = (table @ table.T).tocoo()
    upper = shared.row < shared.col
    weights = coo_array((-shared.data[upper], (shared.row[upper], shared.col[upper])), shape=shared.shape)
    tree = minimum_spanning_tree(weights.tocsr()).tocoo()
    found: list[tuple[Mask, Link]] = []
    for edge in np.argsort(-tree.data, kind="stable").tolist():
        if len(found) == _MOST_CUTS:
            break
        pair = int(tree.row[edge]), int(tree.col[edge])
        rest = np.arange(tree.nnz) != edge
        cut = coo_array((tree.data[rest], (tree.row[rest], tree.col[rest])), shape=tree.shape)
        labels = connected_components(cut, directed=False)[1]
        side = labels == labels[pair[0]]
        smaller = side if 2 * side.sum() <= len(seen) else ~side
        if smaller.sum() < 2:
            continue
        held, error = _across(centers, points, cameras, rows, side, sigma)
        found.append((held, Link(pair, tuple(np.flatnonzero(smaller).tolist()), int(held.sum()), error)))
    return _distinct(sorted(found, key=lambda entry: -entry[1].scale_error))


def _distinct(found: list[tuple[Mask, Link]]) -> list[Link]:
    """Without those that share most points with a weaker one: the same place, cut a step further on."""
    kept: list[tuple[Mask, Link]] = []
    for held, link in found:
        if all(2 * (held & other).sum() < max(held.sum(), 1) for other, _ in kept):
            kept.append((held, link))
    return [link for _, link in kept]


def _across(
    centers: Array, points: Array, cameras: Rows, rows: Rows, side: Mask, sigma: float
) -> tuple[Mask, float]:
    """(P,) which points carry the scale across the cut, and the relative error that they leave."""
    one, other = (
        _information(centers, points, cameras[part], rows[part], sigma)
        for part in (side[cameras], ~side[cameras])
    )
    both = (one > 0) & (other > 0)
    total = (1 / (1 / one[both] + 1 / other[both])).sum()
    return both, float(1 / np.sqrt(total)) if total > 0 else float("inf")


def _information(centers: Array, points: Array, cameras: Rows, rows: Rows, sigma: float) -> Array:
    """(P,) of each point's relative distance from the observations (cameras, rows); 0 below two of them."""
    count = np.bincount(rows, minlength=len(points))
    total = np.stack([np.bincount(rows, centers[cameras, k], len(points)) for k in range(3)], axis=1)
    mean = total / np.maximum(count, 1)[:, None]
    ray = points - mean
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-12)
    ray /= distance[:, None]
    offset = centers[cameras] - mean[rows]
    along = (offset * ray[rows]).sum(axis=1)
    across = np.maximum((offset**2).sum(axis=1) - along**2, 0.0)
    information = np.bincount(rows, across, len(points)) / (distance * sigma) ** 2
    return np.where(count >= 2, information, 0.0)
