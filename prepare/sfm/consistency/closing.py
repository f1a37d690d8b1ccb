"""Loops that drift has left open, closed by the whole graph of panoramas.

The poses of a long walk are off where it returns: what is seen there may be in quite another direction, and a
pair that shows one place differs from its poses as a look-alike does. But drift grows slowly, and all pairs
between two stretches of a walk say the same of it. So each pair whose panoramas both have points of their own
gives the similarity between the two: how the second is turned, where it stands, and how much larger its part
of the world has become. Those that the way between may explain are closed, first those that another one near
them confirms, and whose way is short. Each makes other ways shorter. What stays far off only looks alike.

Rotations, scales and positions are each the solution of one sparse linear system: that in which neighbours
change least.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.consistency.agreement import Posed
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.motion import Motion
from panolog.prepare.sfm.consistency.similarity import (
    LEAST,
    Relations,
    as_posed,
    measured,
    relations_of,
    shared_points,
)
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton

Array = NDArray[np.float64]
_TURNED = 2.5, 0.5  # degrees that a loop may be open, and more for the root of the steps on its way
_GROWN = 0.1, 0.04  # the same for the logarithm of the scale
_MOVED = 0.3, 0.05  # usual steps that it may be open, and more for each step on its way
_NEAR = 6.0  # usual steps between the ends of two loops that may say the same
_SAME = 1.5, 7.5, 0.2  # usual steps, degrees, logarithm of the scale that they differ at most, together
_LEVELS = (0.5, 10), (1.0, 10), (1.0, 100)  # of what loops are expected to be open that another one confirms,
# and steps of the ways of those that none must confirm: those below are closed before the others
_IN_ORDER = 2.0  # times as far those of neighbours may be open, which the order of capture confirms
_LEAST_OPEN = 25  # percent of the loops: they show how much a walk drifts
_TIMES = 10.0  # as far as these, others may be open
_FARTHER, _SHORT = 1.5, 5  # times the shortest way, and steps: loops below both are closed together
_TURNS = 60  # of closing loops
_FIXED = 1e6  # weight of a relation between panoramas whose poses stay
_PULL = 1e-9  # weight of each place towards 0: differences alone do not say where all is


@dataclass(eq=False)
class _Graph:
    """K panoramas as they stand while loops are closed."""

    axes: Array  # (K, 3, 3) camera to world
    centers: Array  # (K, 3)
    sizes: Array  # (K,) logarithm of how much larger the world around each has become
    step: float  # the usual one

    def solve(self, relations: Relations) -> None:
        """Changes all poses so that neighbours differ least from what is known of them."""
        weights = relations.weights
        for _ in range(3):
            turns = _differences(relations.ends, weights, self._turned(relations), len(self.axes))
            self.axes = Rotation.from_rotvec(turns).as_matrix() @ self.axes
        self.sizes = _differences(relations.ends, weights, relations.sizes[:, None], len(self.axes))[:, 0]
        steps = np.linalg.norm(relations.centers, axis=1) / self.step
        far = weights / np.maximum(steps, _MOVED[0]) ** 2
        self.centers = _differences(relations.ends, far, self._shifts(relations), len(self.axes))

    def open(self, relations: Relations) -> tuple[Array, Array, Array]:
        """How far relations are from the poses: (E, 3) degrees, (E,) of the scale, (E, 3) usual steps."""
        first, second = relations.ends.T
        grown = relations.sizes - (self.sizes[second] - self.sizes[first])
        moved = self._shifts(relations) - (self.centers[second] - self.centers[first])
        return np.rad2deg(self._turned(relations)), grown, moved / self._units(first)

    def places(self, relations: Relations) -> Array:
        """(E, 6) where relations begin and end, in usual steps."""
        first, second = relations.ends.T
        return np.concatenate([self.centers[first], self.centers[second]], axis=1) / np.tile(
            self._units(first), 2
        )

    def _units(self, rows: NDArray[np.int64]) -> Array:
        """(E, 3) usual steps at panoramas."""
        return np.repeat(self.step * np.exp(self.sizes[rows])[:, None], 3, axis=1)

    def _turned(self, relations: Relations) -> Array:
        """(E, 3) rotation vectors from the poses to the relations, in the world."""
        first, second = (self.axes[rows] for rows in relations.ends.T)
        turns = first @ relations.rotations.transpose(0, 2, 1) @ second.transpose(0, 2, 1)
        return np.asarray(Rotation.from_matrix(turns).as_rotvec())

    def _shifts(self, relations: Relations) -> Array:
        """(E, 3) from the first panorama to the second in the world, as relations have it."""
        rows = relations.ends[:, 0]
        shifts = np.einsum("eij,ej->ei", self.axes[rows], relations.centers)
        return np.asarray(np.exp(self.sizes[rows])[:, None] * shifts)


def closed(
    found: Posed,
    evidence: Evidence,
    skeleton: Skeleton,
    motion: Callable[[Pair], Motion | None],
    drift: float | None = None,
    contradicting: Collection[Edge] = (),
) -> tuple[Posed, float]:
    """The poses and points of a reconstruction once loops are closed that drift has left open, and the drift.

    Neighbours are the pairs of the tree, and those that share points: what is mapped together agrees.
    Args: skeleton, whose given panoramas do not change against each other, and whose order of capture, if it
        has one, confirms loops between neighbours; motion, of the camera between the panoramas of a pair;
        drift, how far loops may be open, as a share of what a long walk's may be: at most 1, and by default
        what most of these loops show; contradicting, pairs that do not fit the poses: what those of the tree
        that are no guesses say is a loop, too.
    """
    rows = sorted(found.poses)
    place = {row: number for number, row in enumerate(rows)}
    pairs = {it.between: it for it in evidence.pairs if found.poses.keys() >= set(it.between)}
    shared = {edge: float(shared_points(found, pair)) for edge, pair in pairs.items()}
    held = {edge: count for edge, count in shared.items() if edge in skeleton.tree or count >= LEAST}
    usual = max(1.0, float(np.median(list(held.values()) or [0.0])))
    doubted = skeleton.certain.intersection(contradicting)
    rest = [pair for edge, pair in pairs.items() if edge not in held or edge in doubted]
    loops = relations_of([measured(found, evidence, it, motion(it)) for it in rest], place, usual)
    unchanged = found, 1.0 if drift is None else drift
    if not held or not len(loops.ends):
        return unchanged
    held |= dict.fromkeys([edge for edge in skeleton.star if found.poses.keys() >= set(edge)], _FIXED * usual)
    carried = relations_of([as_posed(found, edge, held[edge]) for edge in sorted(held)], place, usual)
    graph = _Graph(
        np.array([found.poses[row][0].T for row in rows]),
        found.centers(rows),
        np.zeros(len(rows)),
        float(np.median(np.linalg.norm(carried.centers, axis=1))),
    )
    if graph.step == 0:
        return unchanged
    drift = _drift(graph, carried, loops) if drift is None else drift
    _close(graph, carried, loops, drift, skeleton.ordered)
    return _moved(found, rows, graph), drift


def _drift(graph: _Graph, carried: Relations, loops: Relations) -> float:
    """How far loops may be open, as those show that are least open."""
    far = _far(_ways(carried, loops.ends, len(graph.axes)), *graph.open(loops))
    return min(1.0, _TIMES * float(np.percentile(np.minimum(far, 1.0), _LEAST_OPEN)))


def _close(graph: _Graph, carried: Relations, loops: Relations, drift: float, ordered: bool) -> None:
    """Closes the loops that the way between may explain, the shortest first."""
    neighbours = ordered & (loops.ends[:, 1] - loops.ends[:, 0] == 1)
    taken, level = np.zeros(len(loops.ends), np.bool_), 0
    for _ in range(_TURNS):
        if taken.any():
            graph.solve(carried + loops[taken])
        if taken.all():
            break
        left, rest = np.flatnonzero(~taken), loops[~taken]
        steps = _ways(carried + loops[taken], rest.ends, len(graph.axes))
        turned, grown, moved = graph.open(rest)
        far = _far(steps, turned, grown, moved)
        says = np.concatenate([graph.places(rest) / _NEAR, moved / _SAME[0], turned / _SAME[1]], axis=1)
        confirmed = _confirmed(np.column_stack([says, grown / _SAME[2]]))
        most, sure = _LEVELS[level]
        fit = ((far < drift) & (steps <= sure)) | ((far < most * drift) & confirmed)
        fit |= (far < _IN_ORDER * most * drift) & neighbours[~taken]
        if fit.any():
            taken[left[fit & (steps <= max(_FARTHER * steps[fit].min(), _SHORT))]] = True
        elif (level := level + 1) == len(_LEVELS):
            break


def _far(steps: Array, turned: Array, grown: Array, moved: Array) -> Array:
    """(E,) how far loops are open, as a share of what they may be after so many steps of a long walk."""
    shares = (
        np.linalg.norm(turned, axis=1) / (_TURNED[0] + _TURNED[1] * np.sqrt(steps)),
        np.abs(grown) / (_GROWN[0] + _GROWN[1] * np.sqrt(steps)),
        np.linalg.norm(moved, axis=1) / (_MOVED[0] + _MOVED[1] * steps),
    )
    return np.where(np.isfinite(steps), np.max(shares, axis=0), np.inf)


def _confirmed(says: Array) -> NDArray[np.bool_]:
    """(E,) which loops another one confirms, that says nearly the same (E, D)."""
    confirmed = np.zeros(len(says), np.bool_)
    confirmed[np.unique(cKDTree(says).query_pairs(1.0, output_type="ndarray"))] = True
    return confirmed


def _ways(relations: Relations, ends: NDArray[np.int64], count: int) -> Array:
    """(E,) how many relations of the usual weight lie between places (E, 2) of `count`; infinite without."""
    graph = csr_array((1 / relations.weights, tuple(relations.ends.T)), shape=(count, count))
    starts, which = np.unique(ends[:, 0], return_inverse=True)
    return np.asarray(dijkstra(graph, directed=False, indices=starts)[which, ends[:, 1]])


def _differences(ends: NDArray[np.int64], weights: Array, between: Array, count: int) -> Array:
    """(K, D) values of `count` places whose differences are nearest to (E, D), by least squares."""
    first, second = ends.T
    rows = np.concatenate([first, second, first, second])
    columns = np.concatenate([first, second, second, first])
    values = np.concatenate([weights, weights, -weights, -weights])
    table = coo_array((values, (rows, columns)), shape=(count, count)) + _PULL * eye_array(count)
    sums = np.zeros((count, between.shape[1]))
    np.add.at(sums, second, weights[:, None] * between)
    np.add.at(sums, first, -weights[:, None] * between)
    return np.asarray(spsolve(table.tocsc(), sums)).reshape(sums.shape)


def _moved(found: Posed, rows: Sequence[int], graph: _Graph) -> Posed:
    """A reconstruction with the poses of a graph, and the points of each panorama moved with it."""
    poses, points = {}, {}
    for number, row in enumerate(rows):
        turn, shift = found.poses[row]
        axes, center = graph.axes[number], graph.centers[number]
        poses[row] = (axes.T, -axes.T @ center)
        points[row] = np.exp(graph.sizes[number]) * (found.points[row] @ turn.T + shift) @ axes.T + center
    return Posed(poses, points)
