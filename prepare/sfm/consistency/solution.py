"""A reconstruction of panoramas, and how all pairs are judged by it."""

from collections.abc import Collection, Sequence, Set
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import Posed, agrees, deviations
from panolog.prepare.sfm.consistency.closing import closed
from panolog.prepare.sfm.consistency.contradictions import (
    Contradiction,
    Kept,
    MotionOf,
    find_contradictions,
    is_trusted,
    refuted_guesses,
)
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.skeleton import Edge, Skeleton, components, hops, tree_paths
from panolog.prepare.sfm.links import Link, links_of
from panolog.prepare.sfm.sparse_model import SparseModel, from_colmap

CLOSE = 2.0  # degrees between where points are and where they are seen, for a pair that fits
SETTLED = 0.03  # of what is mapped: if no more change, another time changes no pose by much
_DRIFT = 0.05  # degrees more for each panorama on the way between the two along pairs that fit
_FARTHEST = 6.0  # degrees at most: a window further on is farther off
_PURE = 0.8  # share of the matches of a pair that fit, for those to count that cannot be judged
_MANY = 4  # panoramas on each side of a guess: fewer may have no pose for want of points, and come last


@dataclass(frozen=True, eq=False)
class Solution:
    """A reconstruction and what it was made of."""

    model: pycolmap.Reconstruction
    contradictions: list[Contradiction]
    evidence: Evidence
    skeleton: Skeleton
    found: Posed
    kept: Kept
    numbers: Sequence[str]  # the name of each panorama in the database
    size: tuple[int, int]  # (width, height) of the panoramas
    motion: MotionOf
    adjusted: bool  # from the closed poses of another, not mapped
    given_drift: float | None  # of loops, as `closed` of `closing` has it; None: as these poses show
    others: Sequence[Set[int]] = ()  # rows that each smaller reconstruction by the same pairs has

    @property
    def trusted(self) -> bool:
        """Whether its poses can be used as they are."""
        return is_trusted(self.contradictions, self.skeleton, self.found.poses)

    @property
    def rank(self) -> tuple[bool, int]:
        """Trust, then the number of poses: the better of two reconstructions has the greater value."""
        return self.trusted, len(self.found.poses)

    @property
    def closed(self) -> Posed:
        """What was found, once the loops are closed that drift has left open."""
        return self._closed[0]

    @property
    def drift(self) -> float:
        """How far loops may be open that are closed."""
        return self._closed[1]

    @cached_property
    def _closed(self) -> tuple[Posed, float]:
        against = {it.between for it in self.contradictions}
        return closed(self.found, self.evidence, self.skeleton, self.motion, self.given_drift, against)

    @cached_property
    def open(self) -> list[Contradiction]:
        """The contradictions to it once loops are closed.

        For these, pairs of the tree give way: that does not contradict. What did before still does if it is a
        guess, or is not resolved.
        """
        against = find_contradictions(self.evidence, self.skeleton, self.closed, CLOSE, self.motion)
        tree = self.skeleton.tree
        still = self.skeleton.guessed | tree.intersection(it.between for it in against)
        own = [it for it in self.contradictions if it.between in still]
        return [*own, *(it for it in against if it.between not in tree)]

    @cached_property
    def agreeing(self) -> Kept:
        """The tree, and the pairs that fit the poses and points, but for drift.

        Those that are not mapped, or do not fit, are judged by the poses once loops are closed.
        """
        evidence, tree = self.evidence, self.skeleton.tree
        off = {pair.between: deviations(self.closed, evidence, pair) for pair in evidence.pairs}
        for pair in (it for it in evidence.pairs if it.between in self.kept):
            mapped = deviations(self.found, evidence, pair)
            if agrees(evidence, pair, mapped, CLOSE):
                off[pair.between] = mapped
        close = {it.between for it in evidence.pairs if agrees(evidence, it, off[it.between], CLOSE)}
        way = hops(self.skeleton.edges | close, len(evidence.rays), off, _FARTHEST / _DRIFT)
        kept: Kept = {}
        for pair in evidence.pairs:
            edge = pair.between
            most = min(CLOSE + _DRIFT * way[edge], _FARTHEST)
            matches = pair.matches if edge in tree else _fitting(evidence, pair, off[edge], most)
            if len(matches):
                kept[edge] = matches
        return kept

    def agreeing_among(self, rows: Collection[int]) -> Kept:
        """The pairs of these panoramas that agree."""
        inside = set(rows)
        return {edge: matches for edge, matches in self.agreeing.items() if inside.issuperset(edge)}

    @property
    def drifted(self) -> bool:
        """Whether closed loops explain what contradicts it: the mapper would drift again."""
        return len(self.open) < len(self.contradictions)

    @property
    def settled(self) -> bool:
        """Whether mapping what agrees would change no pose by much, nor whether it is trusted."""
        change = len(self.agreeing.keys() ^ self.kept.keys())
        would = is_trusted(self.open, self.skeleton, self.found.poses)
        return not change or (change <= SETTLED * len(self.kept) and would == self.trusted)

    @cached_property
    def refuted(self) -> set[Edge]:
        """The guesses that its contradictions refute."""
        return refuted_guesses(self.open, self.skeleton, self.kept)

    @cached_property
    def vain(self) -> set[Edge]:
        """The guesses that contradict themselves, or across which none leads to many panoramas."""
        against, parts = {it.between for it in self.contradictions}, (self.found.poses.keys(), *self.others)
        alone = set(range(len(self.evidence.rays))).difference(*parts)
        joined = [it for it in self.skeleton.edges if any(part >= {*it} for part in (*parts, alone))]
        of = components(joined, len(self.evidence.rays))
        beyond = np.bincount(of)[of]  # panoramas on the same side as each
        return {
            (one, other)
            for one, other in self.skeleton.guessed
            if (one, other) in against or (of[one] != of[other] and beyond[[one, other]].min() >= _MANY)
        }

    def without(self, guesses: Collection[Edge]) -> Kept:
        """The pairs that agree, and are not on different sides of any of these guesses."""
        ways = tree_paths(self.skeleton.edges, list(self.agreeing))
        kept = zip(self.agreeing.items(), ways, strict=True)
        return {edge: matches for (edge, matches), way in kept if not set(way) & set(guesses)}

    @cached_property
    def sparse(self) -> SparseModel:
        """The poses and points in our convention."""
        return from_colmap(self.model, self.numbers, self.size)

    @cached_property
    def links(self) -> list[Link]:
        """Between parts of it, the weakest first."""
        return links_of(self.sparse, self.size[0])


def _fitting(evidence: Evidence, pair: Pair, off: NDArray[np.float64], bound: float) -> NDArray[np.int64]:
    """The matches (M, 2) of a pair that fit, none where most do not, or where it cannot be judged."""
    known = np.isfinite(off)
    if not agrees(evidence, pair, off, bound):
        return pair.matches[:0]
    fit = known & (off <= bound)
    if fit.sum() >= _PURE * known.sum():
        fit |= ~known
    return pair.matches[fit]
