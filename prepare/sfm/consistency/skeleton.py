"""The pairs that carry a reconstruction: neighbours of a walk, or the strongest tree of unordered panoramas.

Neighbours in the order of capture show the same place. Where two share much less than others do, in
directions or in features, the walk may have jumped to where it looks alike: panoramas that share much more,
as where it crosses its way, come before them. Where panoramas were not taken in order, those that share most
of the sphere show the same place: `Evidence` measures how much of it they share, not by the number of
matches.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra, minimum_spanning_tree

from panolog.prepare.sfm.consistency.evidence import LIKE_OTHERS, Evidence, Pair, best_coverage

Edge = tuple[int, int]  # rows of two panoramas, ascending
_ORDERED = 0.8  # share of the neighbours in order that must be pairs, for the order to be that of capture
_WEAK, _FEEBLE = (0.3, 0.5), (0.5, 0.0)  # of coverage and share of neighbours: those with less are left out
_CLEAR = 0.5  # that is shared at one place: streets that look alike share less, as do doubted neighbours
_ALIKE = 0.6  # of that, what either shares with a third place: copies of a place share about as much
_RUN = 3  # panoramas from one to the next, at most, that see one place
_AMONG_BEST = 0.75  # of the best coverage of either panorama
_AT_ONCE = 256  # panoramas whose ways to all others are found together


@dataclass(frozen=True)
class Skeleton:
    """What the first reconstruction is made of."""

    ordered: bool  # panoramas are in the order of capture
    tree: frozenset[Edge]
    guessed: frozenset[Edge] = frozenset()  # of the tree, where the order of capture does not decide
    rivalled: frozenset[Edge] = frozenset()  # of the tree, where another geometry explains about as much
    given: frozenset[int] = frozenset()  # rows of panoramas whose poses are known

    @property
    def star(self) -> frozenset[Edge]:
        """Edges between the panoramas whose poses are known: these need no pairs, and nothing judges them."""
        return frozenset((min(self.given), row) for row in self.given if row > min(self.given))

    @property
    def edges(self) -> frozenset[Edge]:
        """All that connects panoramas."""
        return self.tree | self.star

    @property
    def certain(self) -> frozenset[Edge]:
        """What connects them without a guess."""
        return self.edges - self.guessed

    def among(self, rows: Collection[int]) -> "Skeleton":
        """What of it connects these panoramas."""
        wanted, sets = set(rows), (self.tree, self.guessed, self.rivalled)
        tree, guessed, rivalled = (frozenset(it for it in edges if wanted.issuperset(it)) for edges in sets)
        return Skeleton(self.ordered, tree, guessed, rivalled, self.given & wanted)


def find_skeleton(
    evidence: Evidence,
    places: NDArray[np.float64] | None = None,
    given: Collection[int] = (),
    refuted: Collection[Edge] = (),
) -> Skeleton:
    """The skeleton of panoramas with these verified pairs.

    Args: places, (K, 3) where they were taken, if that is known, NaN where it is not. The nearest ones then
        take the part of neighbours in order; given, rows of panoramas whose poses are known, which count as
        connected: the order is that of the others; refuted, pairs that carry nothing.
    """
    count = len(evidence.rays)
    pairs = [pair for pair in evidence.pairs if pair.between not in refuted]
    pairs.sort(key=lambda it: (-it.coverage, -len(it.matches), it.between))
    if places is not None:
        metres = _near(pairs, places)
        nearest = sorted(pairs, key=lambda it: metres.get(it.between, np.inf))
        return Skeleton(True, frozenset(_strongest_tree(nearest, count)))
    own = [pair for pair in pairs if not set(pair.between) & set(given)]
    ordered = is_ordered(own, count - len(given))
    firm = _chain(own, LIKE_OTHERS, LIKE_OTHERS) if ordered else frozenset()
    weak = _chain(own, *_WEAK) | _chain(own, *_FEEBLE) if ordered else frozenset()
    by_share = sorted(pairs, key=lambda it: -_shared(it))
    clear = _clear(by_share) if ordered else []
    doubted = [it.between for it in by_share if it.between in weak]
    rest = pairs if ordered or given else by_share
    tree = _strongest_tree(rest, count, [*sorted(firm), *clear, *doubted], given)
    return Skeleton(
        ordered,
        frozenset(tree),
        frozenset(tree - firm) if ordered or given else frozenset(),
        frozenset(pair.between for pair in pairs if pair.rivalled and pair.between in tree),
        frozenset(given),
    )


def is_ordered(pairs: Sequence[Pair], count: int) -> bool:
    """Whether most of `count` panoramas share about as much with the next one as with any other."""
    best = best_coverage(pairs)
    near = [pair for pair in pairs if pair.apart == 1]
    fit = [pair for pair in near if pair.coverage >= _AMONG_BEST * min(best[row] for row in pair.between)]
    return count > 2 and len(fit) >= _ORDERED * (count - 1)


def _chain(pairs: Sequence[Pair], covered: float, shared: float) -> frozenset[Edge]:
    """Neighbours in order with at least these parts of others' coverage and share: below, the walk jumped."""
    near = [pair for pair in pairs if pair.apart == 1]
    coverage, share = np.median([[pair.coverage, pair.share] for pair in near], axis=0).tolist()
    return frozenset(
        it.between for it in near if it.coverage >= covered * coverage and it.share >= shared * share
    )


def _shared(pair: Pair) -> float:
    """How much a pair shares: a meadow that repeats is all around, but little of what is seen."""
    return pair.coverage * float(np.sqrt(pair.share))


def _clear(pairs: Sequence[Pair]) -> list[Edge]:
    """The pairs, in their order, that share much at one place, and much less with any third one.

    Who looks like several places stands at one of them at most, and nothing says at which. Neighbours in
    order do at theirs.
    """
    shared: dict[int, dict[int, float]] = {}
    for pair in pairs:
        for row, other in (pair.between, pair.between[::-1]):
            shared.setdefault(row, {})[other] = _shared(pair)

    def elsewhere(row: int, other: int) -> float:
        rows = np.array(sorted({row, *shared[row]}))
        places = np.cumsum(np.diff(rows, prepend=rows[0]) > _RUN)
        third = ~np.isin(places, places[np.isin(rows, (row, other))])
        return max((shared[row][it] for it in rows[third].tolist()), default=0.0)

    def looks_like_others(pair: Pair) -> bool:
        most = max(elsewhere(*it) for it in (pair.between, pair.between[::-1]))
        return most > _ALIKE * _shared(pair)

    much = [pair for pair in pairs if _shared(pair) >= _CLEAR]
    return [pair.between for pair in much if pair.apart == 1 or not looks_like_others(pair)]


def _near(pairs: Sequence[Pair], places: NDArray[np.float64]) -> dict[Edge, float]:
    """The metres between the panoramas of each pair whose places are known."""
    apart = {it.between: float(np.linalg.norm(np.subtract(*places[list(it.between)]))) for it in pairs}
    return {edge: metres for edge, metres in apart.items() if np.isfinite(metres)}


def _strongest_tree(
    pairs: Sequence[Pair],
    count: int,
    first: Iterable[Edge] = (),
    given: Collection[int] = (),
) -> set[Edge]:
    """Kruskal's tree of the edges `first`, then of the pairs in their order.

    Without pairs that share much less than those of the tree: where it falls apart, it is unknown what is
    right. Panoramas that are `given` are connected from the start.
    """
    coverage = {it.between: it.coverage for it in pairs if not set(given).issuperset(it.between)}
    star = [(min(given), row) for row in given if row > min(given)]

    def tree(*edges: Edge) -> set[Edge]:
        once = list(dict.fromkeys((*star, *edges)))
        return set(_spanning(once, np.arange(1.0, len(once) + 1), count)).difference(star)

    usual = [coverage[edge] for edge in tree(*first, *coverage)]
    least = LIKE_OTHERS * float(np.median(usual)) if usual else 0.0
    return tree(*first, *(edge for edge in coverage if coverage[edge] >= least))


def hops(edges: Iterable[Edge], count: int, between: Iterable[Edge], most: float) -> dict[Edge, float]:
    """How many edges lead from one panorama to the other of each pair, infinite if more than `most` do.

    Of few panoramas to all others at a time: a table of all of them would take gigabytes.
    """
    graph = _graph(edges, count)
    others: dict[int, list[int]] = {}
    for one, other in between:
        others.setdefault(one, []).append(other)
    found, all_ = dict[Edge, float](), sorted(others)
    for first in range(0, len(all_), _AT_ONCE):
        some = all_[first : first + _AT_ONCE]
        away = dijkstra(graph, directed=False, indices=some, unweighted=True, limit=most)
        found |= {(one, b): float(row[b]) for one, row in zip(some, away, strict=True) for b in others[one]}
    return found


def components(edges: Iterable[Edge], count: int) -> NDArray[np.int32]:
    """(count,) the number of the part of a graph that each panorama belongs to."""
    return np.asarray(connected_components(_graph(edges, count), directed=False)[1])


def widest_tree(pairs: Iterable[Pair], count: int) -> dict[Edge, float]:
    """The trees of pairs whose least coverage on the way between any two panoramas is largest, with these."""
    coverage = {pair.between: pair.coverage for pair in pairs}
    costs = 2.0 - np.array(list(coverage.values()))  # a graph takes 0 for no edge
    return {edge: coverage[edge] for edge in _spanning(list(coverage), costs, count)}


def tree_path(tree: Iterable[Edge], ends: Edge) -> list[Edge]:
    """The edges of a tree between two panoramas, empty if they are not connected."""
    return tree_paths(tree, [ends])[0]


def tree_paths(tree: Iterable[Edge], pairs: Sequence[Edge]) -> list[list[Edge]]:
    """The edges of a tree between the two panoramas of each pair, empty if they are not connected."""
    edges = list(tree)
    graph = _graph(edges, 1 + max(map(max, (*edges, *pairs)), default=0))
    paths = []
    for one, other in pairs:
        before = breadth_first_order(graph, one, directed=False)[1]  # negative: of the first, or not reached
        path, row = list[Edge](), other
        while (last := int(before[row])) >= 0:
            path.append((min(row, last), max(row, last)))
            row = last
        paths.append(path)
    return paths


def _graph(edges: Iterable[Edge], count: int, costs: NDArray[np.float64] | None = None) -> csr_array:
    """(count, count) with the costs of edges, or 1."""
    table = np.array(list(edges), np.int64).reshape(-1, 2)
    return csr_array((np.ones(len(table)) if costs is None else costs, tuple(table.T)), shape=(count, count))


def _spanning(edges: Sequence[Edge], costs: NDArray[np.float64], count: int) -> Iterator[Edge]:
    """The edges of the cheapest tree of each part of a graph. Args: costs, above 0."""
    tree = minimum_spanning_tree(_graph(edges, count, costs)).tocoo()
    return zip(tree.row.tolist(), tree.col.tolist(), strict=True)
