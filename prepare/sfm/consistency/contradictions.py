"""Pairs of panoramas whose poses contradict their matches: the sign of a reconstruction misled by repetition.

Two panoramas that share as much of the sphere as neighbours do must see the same points. If those of one are
elsewhere in the other, one of the two poses is wrong: rows of equal windows have matched one window further
on, and from there everything fits again, one window off. Neither residuals nor weak links show that.

In the order of capture, neighbours are known. A pair that is farther off than a walk along them can drift
only looks alike. Without an order nothing distinguishes such a pair from a true one, so it contradicts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from panolog.prepare.sfm.consistency.agreement import FEW, Posed, deviations
from panolog.prepare.sfm.consistency.evidence import Evidence
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton, tree_path

_AS_NEIGHBOURS = 0.9  # of the median coverage of the pairs that carry the reconstruction
_UNORDERED = 0.6  # of it without an order: what looks alike is then not distinguished from what is near
_DRIFTED = 20.0  # degrees that a walk may be off where it returns
_MOST = 0.02  # contradictions for each panorama, but for those of the tree, of which there may be none


@dataclass(frozen=True)
class Contradiction:
    """Two panoramas with many matches, of which few fit their poses."""

    between: Edge  # rows of the panoramas
    matches: int  # verified ones, of which a point is known
    points: int  # of these, whose points are where they are seen


def find_contradictions(
    evidence: Evidence, skeleton: Skeleton, found: Posed, bound: float
) -> list[Contradiction]:
    """The contradictions in a reconstruction, the strongest first; bound, degrees that points may be off."""
    of_tree = [pair.coverage for pair in evidence.pairs if pair.between in skeleton.tree]
    share = _AS_NEIGHBOURS if skeleton.ordered else _UNORDERED
    strong = share * float(np.median(of_tree)) if of_tree else np.inf
    contradictions = []
    for pair in evidence.pairs:
        carries = pair.between in skeleton.tree
        if carries or pair.coverage >= strong:
            off = deviations(found, evidence, pair)
            off = off[np.isfinite(off)]
            if len(off) < FEW or np.median(off) <= bound:
                continue
            if carries or not skeleton.ordered or np.median(off) < _DRIFTED:
                contradictions.append(Contradiction(pair.between, len(off), int((off <= bound).sum())))
    return sorted(contradictions, key=lambda it: (it.points - it.matches, it.between))


def is_trusted(contradictions: Sequence[Contradiction], skeleton: Skeleton, count: int) -> bool:
    """Whether poses of `count` panoramas can be used in spite of the contradictions."""
    broken = any(it.between in skeleton.tree for it in contradictions)
    return not broken and len(contradictions) <= max(1, _MOST * count)


def consistent_part(
    rows: Sequence[int],
    contradictions: Sequence[Contradiction],
    skeleton: Skeleton,
    evidence: Evidence,
) -> list[int]:
    """The largest part of panoramas without a contradiction between them, ascending.

    The tree is cut where it is weakest between two that contradict each other, and the smaller side left out.
    """
    coverage = {pair.between: pair.coverage for pair in evidence.pairs}
    part, tree = set(rows), {edge for edge in skeleton.tree if set(edge) <= set(rows)}
    for it in contradictions:
        if not set(it.between) <= part:
            continue
        path = tree_path(tree, it.between)
        if not path:
            part -= {max(it.between)}
            continue
        tree.remove(min(path, key=lambda edge: (coverage[edge], edge)))
        sides = [{row for row in part if row == end or tree_path(tree, (end, row))} for end in it.between]
        part = max(sides, key=len)
        tree = {edge for edge in tree if set(edge) <= part}
    return sorted(part)
