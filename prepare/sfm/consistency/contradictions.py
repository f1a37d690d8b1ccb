"""Pairs of panoramas whose poses contradict their matches: the sign of a reconstruction misled by repetition.

Two panoramas that share as much of the sphere as neighbours do must see the same points. If those of one are
elsewhere in the other, one of the two poses is wrong: rows of equal windows have matched one window further
on, and from there everything fits again, one window off. Neither residuals nor weak links show that.

In the order of capture, neighbours are known. A pair that is farther off than a walk along them can drift
only looks alike. Without an order nothing distinguishes such a pair from a true one, so it contradicts; nor
does it where the order was followed only by a guess on the way from one to the other.

Where even neighbours have a second geometry that explains about as much as the first, nothing contradicts
either. Single ones are decided by what lies around; where there are many, the whole is not trusted.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from panolog.prepare.sfm.consistency.agreement import FEW, Posed, deviations, has_moved
from panolog.prepare.sfm.consistency.evidence import Evidence
from panolog.prepare.sfm.consistency.skeleton import Edge, MotionOf, Skeleton, components, tree_path, unknown

_AS_NEIGHBOURS = 0.9  # of the median coverage of the pairs that carry the reconstruction
_UNORDERED = 0.6  # of it without an order: what looks alike is then not distinguished from what is near
_DRIFTED = 20.0  # degrees that a walk may be off where it returns
_RIVALLED = 0.3  # of the edges of the tree that may have a rival
_MOST = 0.02  # contradictions for each panorama, but for those of the tree, of which there may be none


@dataclass(frozen=True)
class Contradiction:
    """Two panoramas with many matches, of which few fit their poses."""

    between: Edge  # rows of the panoramas
    matches: int  # verified ones, of which a point is known
    points: int  # of these, whose points are where they are seen


def find_contradictions(
    evidence: Evidence, skeleton: Skeleton, found: Posed, bound: float, motion: MotionOf = unknown
) -> list[Contradiction]:
    """The contradictions in a reconstruction, the strongest first.

    Args: bound, degrees that points may be off; motion, of the camera between the panoramas of a pair, by
        which pairs that carry the reconstruction are judged where too few of their points are known.
    """
    of_tree = [pair.coverage for pair in evidence.pairs if pair.between in skeleton.tree]
    share = _AS_NEIGHBOURS if skeleton.ordered else _UNORDERED
    strong = share * float(np.median(of_tree)) if of_tree else np.inf
    contradictions = []
    sides = components(skeleton.tree - skeleton.guessed, len(evidence.rays))
    for pair in evidence.pairs:
        carries = pair.between in skeleton.tree
        if not carries and pair.coverage < strong:
            continue
        off = deviations(found, evidence, pair)
        off = off[np.isfinite(off)]
        if len(off) < FEW:
            if carries and not has_moved(found, pair.between, motion(pair)):
                contradictions.append(Contradiction(pair.between, len(pair.matches), 0))
            continue
        if np.median(off) <= bound:
            continue
        guessed = sides[pair.between[0]] != sides[pair.between[1]]
        if carries or guessed or not skeleton.ordered or np.median(off) < _DRIFTED:
            contradictions.append(Contradiction(pair.between, len(off), int((off <= bound).sum())))
    return sorted(contradictions, key=lambda it: (it.points - it.matches, it.between))


def is_repetitive(skeleton: Skeleton, rows: Collection[int]) -> bool:
    """Whether too many of the pairs that carry poses of panoramas have a geometry that rivals theirs."""
    tree = [edge for edge in skeleton.tree if set(edge) <= set(rows)]
    return len(skeleton.rivalled.intersection(tree)) > _RIVALLED * len(tree)


def is_trusted(contradictions: Sequence[Contradiction], skeleton: Skeleton, rows: Collection[int]) -> bool:
    """Whether poses of panoramas can be used in spite of contradictions and of geometries that have rivals.

    Where the order was followed by a guess, there may be no contradiction.
    """
    broken = any(it.between in skeleton.tree for it in contradictions)
    guessed = any(edge in skeleton.tree and set(edge) <= set(rows) for edge in skeleton.guessed)
    few = len(contradictions) <= (0 if guessed else max(1, _MOST * len(rows)))
    return few and not broken and not is_repetitive(skeleton, rows)


def consistent_part(
    rows: Sequence[int],
    contradictions: Sequence[Contradiction],
    skeleton: Skeleton,
    evidence: Evidence,
) -> list[int]:
    """The largest part of panoramas without a contradiction between them, ascending.

    The tree is cut where it is weakest between two that contradict each other, and the smaller side left out;
    where too many geometries have rivals, at all of these before.
    """
    coverage = {pair.between: pair.coverage for pair in evidence.pairs}
    part, tree = set(rows), {edge for edge in skeleton.tree if set(edge) <= set(rows)}
    if is_repetitive(skeleton, rows):
        tree -= skeleton.rivalled
        part = _largest(part, tree, sorted(part), len(evidence.rays))
    for it in contradictions:
        if not set(it.between) <= part:
            continue
        path = tree_path(tree, it.between)
        if not path:
            part -= {max(it.between)}
            continue
        tree.remove(min(path, key=lambda edge: (coverage[edge], edge)))
        part = _largest(part, tree, it.between, len(evidence.rays))
        tree = {edge for edge in tree if set(edge) <= part}
    return sorted(part)


def _largest(part: set[int], tree: set[Edge], ends: Sequence[int], count: int) -> set[int]:
    """The rows of a part that a tree connects with one of the ends: the most, of equally many the first."""
    of = components(tree, count)
    return max(({row for row in part if of[row] == of[end]} for end in ends), key=len)
