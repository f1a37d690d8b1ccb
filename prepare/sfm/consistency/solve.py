"""From verified pairs to a reconstruction that look-alikes cannot mislead.

The skeleton alone is mapped first. It has no loops, so no look-alike can bend it. All other pairs are then
judged by it: their points must be where they are seen, but for its drift. With those that are, the mapper
starts again, and closes wider loops each time, until no more pairs agree. Panoramas that this does not reach
are added last.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import Posed, agrees, deviations, posed
from panolog.prepare.sfm.consistency.contradictions import (
    DRIFTED,
    Contradiction,
    Kept,
    consistent_part,
    doubted_guesses,
    find_contradictions,
    is_trusted,
    refuted_guesses,
)
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, best_coverage, read_evidence
from panolog.prepare.sfm.consistency.guided import Guide
from panolog.prepare.sfm.consistency.motion import Geometries, look_again
from panolog.prepare.sfm.consistency.skeleton import (
    Edge,
    Skeleton,
    components,
    find_skeleton,
    hops,
    tree_paths,
)
from panolog.prepare.sfm.links import Link, links_of
from panolog.prepare.sfm.mapping import Mapper, map_pairs
from panolog.prepare.sfm.sparse_model import SparseModel, from_colmap
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_CLOSE = 2.0  # degrees between where points are and where they are seen, for a pair that fits
_DRIFT = 0.05  # degrees more for each panorama on the way between the two along pairs that fit
_FARTHEST = 6.0  # degrees at most: a window further on is farther off
_RETURNS = 0.2  # degrees instead, up to DRIFTED, for what shares as much as neighbours: thin walks drift so
_SETTLED = 0.03  # of the pairs that are mapped: if no more change, another time changes no pose by much
_PURE = 0.8  # share of the matches of a pair that fit, for those to count that cannot be judged
_ROUNDS = 8  # of mapping with the pairs that fit
_AS_NEIGHBOURS = 0.9  # of the median of the best coverage of panoramas whose poses are known
_MANY = 4  # panoramas beyond a guess: fewer may have no pose for want of points, and are added last
_GUESSES = 4  # times that the next pairs take the place of guesses, before loops are closed and after
_LOOSE = 100.0  # relative error of the scale across a link: one side is a point for the other
_RIM = 0.1  # share of the panoramas that may be left out without an order: all others agree


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

    @property
    def trusted(self) -> bool:
        """Whether its poses can be used as they are."""
        return is_trusted(self.contradictions, self.skeleton, self.found.poses)

    @property
    def rank(self) -> tuple[bool, int]:
        """Trust, then the number of poses: the better of two reconstructions has the greater value."""
        return self.trusted, len(self.found.poses)

    @cached_property
    def against(self) -> set[Edge]:
        """The pairs that contradict it."""
        return {it.between for it in self.contradictions}

    @cached_property
    def agreeing(self) -> Kept:
        """The tree, and the pairs that fit the poses and points, but for drift.

        What contradicts may have drifted as far as a walk does where it returns.
        """
        evidence, tree = self.evidence, self.skeleton.tree
        off = {pair.between: deviations(self.found, evidence, pair) for pair in evidence.pairs}
        close = {it.between for it in evidence.pairs if agrees(evidence, it, off[it.between], _CLOSE)}
        count = len(evidence.rays)
        way = hops(self.skeleton.edges | close, count, off, _FARTHEST / _DRIFT)
        walk = hops(self.skeleton.edges, count, self.against, DRIFTED / _RETURNS)
        most = {edge: min(_CLOSE + _DRIFT * steps, _FARTHEST) for edge, steps in way.items()}
        most |= {edge: min(_CLOSE + _RETURNS * steps, DRIFTED) for edge, steps in walk.items()}
        kept: Kept = {}
        for pair in evidence.pairs:
            edge = pair.between
            matches = pair.matches if edge in tree else _fitting(evidence, pair, off[edge], most[edge])
            if len(matches):
                kept[edge] = matches
        return kept

    @property
    def closing(self) -> bool:
        """Whether what contradicts it may close a loop: it agrees but for drift, and was not mapped."""
        return not self.kept.keys() >= self.agreeing.keys() & self.against

    @property
    def settled(self) -> bool:
        """Whether mapping what agrees would change no pose by much."""
        change = self.agreeing.keys() ^ self.kept.keys()
        return not self.closing and len(change) <= _SETTLED * len(self.kept)

    @cached_property
    def refuted(self) -> set[Edge]:
        """The guesses that its contradictions refute."""
        return refuted_guesses(self.contradictions, self.skeleton, self.kept)

    @cached_property
    def vain(self) -> set[Edge]:
        """The guesses that contradict themselves, or that lead to many panoramas and no pose."""
        poses = self.found.poses.keys()
        of = components([it for it in self.skeleton.edges if not poses & it], len(self.evidence.rays))
        beyond = np.bincount(of)[of]  # panoramas without a pose that are connected with each
        return {
            it
            for it in self.skeleton.guessed
            if it in self.against or (len(poses & it) == 1 and beyond[list(it)].max() >= _MANY)
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


class Solver:
    """Reconstructs the panoramas of a database, or some of them."""

    def __init__(
        self,
        work: Workspace,
        size: tuple[int, int],
        mapper: Mapper,
        max_error: float,
        progress: StageProgress,
        places: NDArray[np.float64] | None = None,
        known: pycolmap.Reconstruction | None = None,
    ) -> None:
        """Args: size, (width, height) of the panoramas; max_error, pixels that an observation may be off;
        places, (K, 3) where panoramas were taken, if that is known, else NaN; known, poses that stay, with
        their points, of panoramas of the database.
        """
        self._work, self._mapper, self._max_error, self._progress = work, mapper, max_error, progress
        self._size, self._ids, evidence = size, work.ids(), read_evidence(work, size)
        self._geometries = Geometries(work, size, max_error, evidence)
        evidence = look_again(self._geometries.marked(evidence), self._geometries)
        self._known, self._given, self._refuted, self._places = known, set[int](), set[Edge](), places
        self._doubted = set[Edge]()  # guesses that contradictions have led across
        if known is not None:
            self._given = set(posed(known, self._ids).poses)
            judged = [pair for pair in evidence.pairs if not self._given.issuperset(pair.between)]
            self._refuted = _looking_alike(judged, evidence.among(self._given).pairs, self._given)
            evidence = replace(evidence, pairs=tuple(judged))
        self._skeleton = find_skeleton(evidence, places, self._given, self._refuted)
        self._guide = Guide(work, evidence.rays, max_error * 2 * np.pi / size[0])
        self._evidence = self._thicker(evidence, self._skeleton.tree)
        self.cuts: list[Contradiction] = []  # for which `parts` has left panoramas out
        self.unconfirmed = set[int]()  # that were left out because a single pair held them

    def parts(self, least: int, doubtful: bool = False) -> list[Solution]:
        """Reconstructions of different panoramas, each without a contradiction, the largest first.

        What contradicts itself is cut where it is weakest, what is a point for the rest is cut off, and each
        side is reconstructed again.
        Args: least, panoramas of a part; doubtful, also without an order where the cut does not only leave
            out a few: nothing says then which of the pairs within a side that agree are wrong together.
        """
        todo, found = [set(range(len(self._ids)))], list[Solution]()
        while todo:
            rows = todo.pop()
            part = self._part(rows, doubtful or self._skeleton.ordered) if len(rows) >= least else None
            if part is not None and (loose := _shrunk(part)):
                todo += [rows - loose, loose]
            elif part is not None and len(part.found.poses) >= least:
                found.append(part)
                todo += self._sides(rows - part.found.poses.keys())
        return sorted(found, key=lambda part: -len(part.found.poses))

    def joined(self) -> Solution | None:
        """What is known with those of the other panoramas that agree with it; None if there are none.

        What leads from these to it is guessed by looks. What contradicts after several guesses is cut off.
        """
        found = self._part(range(len(self._ids)), cut=True)
        return found if found is not None and found.found.poses.keys() > self._given else None

    def _guessed(self, rows: Collection[int], begun: Kept) -> Solution | None:
        """The reconstruction of these panoramas: a guess that it refutes makes room for the next one."""
        found = self.solve(rows, begun)
        for _ in range(_GUESSES):
            if found is None or not found.refuted:
                break
            self._refute(found.refuted)
            found = self.solve(rows, found.without(found.refuted))
        return found

    def _refute(self, guesses: Collection[Edge]) -> None:
        """Puts the next pairs in the place of guesses."""
        self._refuted |= set(guesses)
        before = self._skeleton
        self._skeleton = find_skeleton(self._evidence, self._places, self._given, self._refuted)
        self._evidence = self._thicker(self._evidence, self._skeleton.tree - before.tree)

    def _part(self, rows: Collection[int], cut: bool) -> Solution | None:
        """The reconstruction of the most of these panoramas that agree.

        Panoramas that no pair of the skeleton carries stay, unless they contradict. Without `cut`, None where
        more than `_RIM` of the panoramas would be left out.
        """
        first = 0  # panoramas that had a pose before anything was cut
        while (found := self._guessed(rows, {})) is not None and not found.trusted:
            before = sorted(found.found.poses)
            first = first or len(before)
            self._doubted |= doubted_guesses(found.contradictions, found.skeleton)
            agreed = consistent_part(before, found.contradictions, found.skeleton, found.evidence)
            sides = [(side >= self._given, len(side), side) for side in self._sides(agreed)]
            *_, rows = max(sides, key=lambda it: it[:2], default=(False, 0, set[int]()))
            carried = (*found.skeleton.edges, *found.against)
            rows |= set(before).difference(*carried)
            if not cut and len(rows) < (1 - _RIM) * first:
                self.cuts += found.contradictions
                return None
            if len(rows) == len(before):
                return None
            self.cuts += [it for it in found.contradictions if not set(it.between) <= set(rows)]
        if found is not None and (loose := _unconfirmed(found)):
            self.unconfirmed |= loose
            rows = found.found.poses.keys() - loose
            found = self._guessed(rows, {it: found.agreeing[it] for it in found.agreeing if rows >= {*it}})
        return found if found is not None and found.trusted else None

    def _thicker(self, evidence: Evidence, edges: Collection[Edge]) -> Evidence:
        """The pairs of these edges with what matches along their motion."""

        def thicker(pair: Pair) -> Pair:
            motion = self._geometries.motion(pair) if pair.between in edges else None
            if motion is None:
                return pair
            matches = self._guide.along(pair.between, motion)
            more = len(matches) >= len(pair.matches)
            return self._geometries.mark(replace(pair, matches=matches), motion) if more else pair

        return replace(evidence, pairs=tuple(map(thicker, evidence.pairs)))

    def _sides(self, rows: Collection[int]) -> list[set[int]]:
        """The parts of these panoramas that the skeleton connects, but for guesses that are doubted.

        Poses that are known judge also what such a guess connects with them.
        """
        skeleton = self._skeleton.among(rows)
        of = components(skeleton.edges - (set() if skeleton.given else self._doubted), len(self._ids))
        return [{row for row in rows if of[row] == side} for side in sorted({int(of[row]) for row in rows})]

    def solve(self, rows: Collection[int], begun: Kept) -> Solution | None:
        """The reconstruction of these panoramas by the pairs that agree; None if there is none.

        Args: begun, pairs that are known to agree.
        """
        new, best, turn, reached = self._begun(rows, begun), None, 0, False
        while new is not None:
            refuted = turn > 0 and not new.closing and bool(new.refuted)
            if new.settled and not refuted and not reached:
                new, reached = self._reaching(new), True
            # The tree alone is not judged by all that its poses decide.
            if best is None or turn == 1 or new.rank >= best.rank:
                best = new
            if new.settled or refuted or turn == _ROUNDS:
                break
            new = self._mapped(new.evidence, new.skeleton, new.agreeing, self._mapper)
            turn += 1
        return best

    def _begun(self, rows: Collection[int], begun: Kept) -> Solution | None:
        """The reconstruction of these panoramas by the tree, and by what is known to agree.

        Vain guesses make room for the next ones. Of these attempts that with most poses is taken.
        """
        best, most = None, (0, 0)
        for _ in range(_GUESSES):
            evidence, skeleton = self._evidence.among(rows), self._skeleton.among(rows)
            tree = {pair.between: pair.matches for pair in evidence.pairs if pair.between in skeleton.tree}
            new = self._mapped(evidence, skeleton, begun | tree, "incremental")
            if new is None:
                break
            if (worth := (len(new.found.poses), -len(new.vain))) > most:
                best, most = new, worth
            if not new.vain:
                break
            begun = new.without(new.vain) if begun else {}
            self._refute(new.vain)
        return best

    def _reaching(self, base: Solution) -> Solution:
        """A reconstruction with panoramas that what agrees has not reached, by all their pairs.

        Those that contradict are left out. The poses of the others stay.
        """
        pairs, found = base.evidence.pairs, base.found.poses.keys()
        rest = {row for pair in pairs for row in pair.between} - found
        while rest:
            theirs = {
                it.between: it.matches
                for it in pairs
                if rest & {*it.between} and {*it.between} <= rest | found
            }
            new = self._mapped(base.evidence, base.skeleton, base.agreeing | theirs, "incremental", base)
            if new is None:
                break
            if not (wrong := {row for it in new.contradictions for row in it.between} & rest):
                return new
            rest -= wrong
        return base

    def _mapped(
        self, evidence: Evidence, skeleton: Skeleton, kept: Kept, mapper: Mapper, base: Solution | None = None
    ) -> Solution | None:
        """The reconstruction by these pairs; None if there is none. Args: base, whose poses stay."""
        known, given = (base.model, base.found.poses) if base else (self._known, self._given)
        part = self._work.with_pairs(kept, "pairs.db", given)
        model = map_pairs(part, mapper, self._max_error, self._progress, known)
        if model is None:
            return None
        found = posed(model, self._ids)
        against = find_contradictions(evidence, skeleton, found, _CLOSE, self._geometries.motion)
        return Solution(model, against, evidence, skeleton, found, kept, self._work.numbers, self._size)


def _looking_alike(pairs: Sequence[Pair], known: Sequence[Pair], given: Collection[int]) -> set[Edge]:
    """The pairs with panoramas of known poses that cover less than these cover of each other.

    They may only look alike: what connects panoramas with a scene is as near as neighbours in it.
    Args: known, the pairs between panoramas of known poses.
    """
    best = best_coverage(known)
    least = _AS_NEIGHBOURS * float(np.median(list(best.values()))) if best else 0.0
    return {it.between for it in pairs if it.coverage < least and not set(it.between).isdisjoint(given)}


def _shrunk(solution: Solution) -> set[int]:
    """The panoramas on the smaller side of a link across which one side is a point for the other.

    No pair contradicts that: where a step seems to lead back, what follows fits if it is small enough.
    """
    loose = next((it.smaller for it in solution.links if _LOOSE <= it.scale_error < np.inf), ())
    return {solution.sparse.rows[place] for place in loose}


def _unconfirmed(solution: Solution) -> set[int]:
    """The panoramas with a pose that a single pair holds, unless the order of capture confirms it.

    A pair that looks alike gives a pose, too: only a second one shows that it is right.
    """
    skeleton, found = solution.skeleton, solution.found
    firm = skeleton.certain if skeleton.ordered or skeleton.given else frozenset[Edge]()
    held = Counter[int]()
    for pair in solution.evidence.pairs:
        off = deviations(found, solution.evidence, pair)
        if pair.between in skeleton.tree or agrees(solution.evidence, pair, off, _CLOSE):
            held.update(pair.between)
    return {row for row in found.poses if held[row] < 2}.difference(*firm)


def _fitting(evidence: Evidence, pair: Pair, off: NDArray[np.float64], bound: float) -> NDArray[np.int64]:
    """The matches (M, 2) of a pair that fit, none where most do not, or where it cannot be judged."""
    known = np.isfinite(off)
    if not agrees(evidence, pair, off, bound):
        return pair.matches[:0]
    fit = known & (off <= bound)
    if fit.sum() >= _PURE * known.sum():
        fit |= ~known
    return pair.matches[fit]
