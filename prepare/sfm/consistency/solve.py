"""From verified pairs to a reconstruction that look-alikes cannot mislead.

The skeleton alone is mapped first. It has no loops, so no look-alike can bend it. Loops that its drift has
left open are closed, and all other pairs judged by that: their points must be where they are seen. With those
that are, panoramas are mapped again, or adjusted where the mapper drifts, until no more pairs agree.
Panoramas that this does not reach are added last.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import Posed, agrees, deviations, motion_between, posed
from panolog.prepare.sfm.consistency.contradictions import (
    Contradiction,
    Kept,
    consistent_part,
    doubted_guesses,
    find_contradictions,
)
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair, best_coverage, read_evidence
from panolog.prepare.sfm.consistency.guided import Guide
from panolog.prepare.sfm.consistency.motion import Geometries, look_again
from panolog.prepare.sfm.consistency.skeleton import (
    Edge,
    Skeleton,
    components,
    find_skeleton,
)
from panolog.prepare.sfm.consistency.solution import CLOSE, SETTLED, Solution
from panolog.prepare.sfm.mapping import DIRECT, Mapper, adjust_poses, map_pairs
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

_ROUNDS = 8  # of mapping with the pairs that fit
_AS_NEIGHBOURS = 0.9  # of the median of the best coverage of panoramas whose poses are known
_GUESSES = 4  # times that the next pairs take the place of guesses, before loops are closed and after
_LOOSE = 100.0  # relative error of the scale across a link: either side may be a point for the other
_STRAY = 6.0  # usual steps that panoramas are from those before and after them
_ASTRAY = 4  # at most one after the other: more may be a way of their own
_MISFITS = 0.005  # pairs for each panorama that agreed, and do not fit once all is adjusted
_RIM = 0.1  # share of the panoramas that may be left out without an order: all others agree


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
        self._drift: float | None = None  # that the last tree has shown
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

        What contradicts itself is cut where it is weakest, what nothing holds the scale of is cut off, and
        each side is reconstructed again.
        Args: least, panoramas of a part; doubtful, also without an order where the cut does not only leave
            out a few: nothing says then which of the pairs within a side that agree are wrong together.
        """
        todo, found = [set(range(len(self._ids)))], list[Solution]()
        while todo:
            rows = todo.pop()
            part = self._part(rows, doubtful or self._skeleton.ordered) if len(rows) >= least else None
            if part is not None and (loose := _loose(part)):
                todo += [rows - loose, loose]
            elif part is not None and len(part.found.poses) >= least:
                found.append(self._refined(part))
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
            carried = (*found.skeleton.edges, *(it.between for it in found.contradictions))
            rows |= set(before).difference(*carried)
            if not cut and len(rows) < (1 - _RIM) * first:
                self.cuts += found.contradictions
                return None
            if len(rows) == len(before):
                return None
            self.cuts += [it for it in found.contradictions if not set(it.between) <= set(rows)]
        if found is not None and (loose := _unconfirmed(found)):
            self.unconfirmed |= loose
            found = self._without(found, loose)
        return found if found is not None and found.trusted else None

    def _without(self, base: Solution, loose: Collection[int]) -> Solution | None:
        """The reconstruction of the other panoramas of one by their pairs that agree with it."""
        rows = base.found.poses.keys() - loose
        kept = base.agreeing_among(rows)
        if not base.adjusted:
            return self._guessed(rows, kept)
        model = pycolmap.Reconstruction(base.model)
        self._remove_poses(model, loose)
        # The others do not move, so nothing new contradicts them, though they connect less of the tree.
        return replace(
            base,
            model=model,
            contradictions=[it for it in base.contradictions if rows >= {*it.between}],
            evidence=base.evidence.among(rows),
            skeleton=base.skeleton.among(rows),
            found=posed(model, self._ids),
            kept=kept,
        )

    def _thicker(self, evidence: Evidence, edges: Collection[Edge]) -> Evidence:
        """The pairs of these edges with what matches along their motion."""
        pairs = {pair.between: pair for pair in evidence.pairs}
        verified = sorted(pairs.keys() & edges)
        for done, edge in enumerate(verified):
            self._progress("poses", done, len(verified))
            if (motion := self._geometries.motion(pairs[edge])) is None:
                continue
            matches = self._guide.along(edge, motion)
            if len(matches) >= len(pairs[edge].matches):
                pairs[edge] = self._geometries.mark(replace(pairs[edge], matches=matches), motion)
        return replace(evidence, pairs=tuple(pairs.values()))

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
            refuted = turn > 0 and bool(new.refuted)
            if new.settled and not refuted and not reached:
                new, reached = self._reaching(new), True
            # The tree alone is not judged by all that its poses decide.
            if best is None or turn == 1 or new.rank >= best.rank:
                best = new
            final = reached and new.adjusted and new.trusted  # what is left is the last adjustment
            if new.settled or final or refuted or turn == _ROUNDS:
                break
            adjusted = self._adjusted(new) if new.adjusted or new.drifted else None
            new = adjusted or self._mapped(new.evidence, new.skeleton, new.agreeing, self._mapper)
            turn += 1
        return best

    def _begun(self, rows: Collection[int], begun: Kept) -> Solution | None:
        """The reconstruction of these panoramas by the tree, and by what is known to agree.

        Vain guesses make room for the next ones. Of these attempts that with most poses is taken.
        """
        best, most = None, (0, 0)
        self._drift = self._drift if begun else None
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
        self._drift = best.drift if best else None
        return best

    def _reaching(self, base: Solution) -> Solution:
        """A reconstruction with panoramas that what agrees has not reached, by all their pairs.

        Those that contradict are left out. The poses of the others stay.
        """
        found = base.found.poses.keys()
        rest = {row for pair in base.evidence.pairs for row in pair.between} - found
        while rest:
            pairs = base.evidence.among(rest | found).pairs
            theirs = {it.between: it.matches for it in pairs if rest & {*it.between}}
            kept = base.agreeing_among(rest | found) | theirs
            new = self._mapped(base.evidence, base.skeleton, kept, "incremental", base)
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
        models = map_pairs(part, mapper, self._max_error, self._progress, known)
        if not models:
            return None
        model, *others = models
        large = mapper == "incremental" and known is None and len(self._ids) > DIRECT
        if large:  # which the mapper has not adjusted as a whole
            model = adjust_poses(part, model, posed(model, self._ids).poses, self._max_error) or model
        adjusted = large or (base is not None and base.adjusted)
        solution = self._solution(model, evidence, skeleton, kept, adjusted)
        rows = {number: row for row, number in enumerate(self._ids)}
        return replace(solution, others=[{rows[number] for number in it.reg_image_ids()} for it in others])

    def _adjusted(self, base: Solution) -> Solution | None:
        """The reconstruction by what agrees, from the poses once loops are closed.

        None where many that the tree carries have no pose yet, poses stay, or another mapper is wanted.
        """
        poses = base.closed.poses
        carried = {row for edge in base.skeleton.tree for row in edge}
        missing = len(carried - poses.keys())
        if self._given or self._mapper == "global" or missing > SETTLED * len(carried):
            return None
        kept = base.agreeing_among(poses)
        part = self._work.with_pairs(kept, "pairs.db", range(len(self._ids)))
        new = adjust_poses(part, base.model, poses, self._max_error)
        if new is None:
            return None
        return self._solution(new, base.evidence, base.skeleton, kept, adjusted=True)

    def _refined(self, base: Solution) -> Solution:
        """A reconstruction with all that matches along the motions between its poses: that drifts less."""
        poses, kept = base.found.poses, dict(base.agreeing)
        for done, edge in enumerate(base.agreeing):
            self._progress("poses", done, len(kept))
            motion = motion_between(base.found, edge) if poses.keys() >= {*edge} else None
            if motion is not None:
                kept[edge] = np.unique(np.concatenate([kept[edge], self._guide.along(edge, motion)]), axis=0)
        part = self._work.with_pairs(kept, "pairs.db", range(len(self._ids)))
        self._progress("poses", len(kept), len(kept))
        model = adjust_poses(part, base.model, poses, self._max_error, last=True)
        if model is None:
            return base
        new = self._solution(model, base.evidence, base.skeleton, kept, base.adjusted)
        # More points show more look-alikes, but no more of whether poses are right: what agreed still must.
        misfits = sum(it.between in base.agreeing for it in new.contradictions)
        same = new.found.poses.keys() == poses.keys() and misfits <= _MISFITS * len(poses)
        return replace(new, contradictions=base.contradictions) if same else base

    def _remove_poses(self, model: pycolmap.Reconstruction, rows: Iterable[int]) -> None:
        """Leaves panoramas out of a model."""
        for row in rows:
            model.deregister_frame(model.image(self._ids[row]).frame_id)

    def _solution(
        self,
        model: pycolmap.Reconstruction,
        evidence: Evidence,
        skeleton: Skeleton,
        kept: Kept,
        adjusted: bool,
    ) -> Solution:
        """A reconstruction by these pairs, with what contradicts it."""
        found, motion = posed(model, self._ids), self._geometries.motion
        # Without an order it shows that the tree is wrong elsewhere, too, and has to contradict.
        if skeleton.ordered and (shrunk := found.shrunk() - self._given):
            self._remove_poses(model, shrunk)
            found = posed(model, self._ids)
        against = find_contradictions(evidence, skeleton, found, CLOSE, motion)
        rest = self._work.numbers, self._size, motion, adjusted, self._drift
        return Solution(model, against, evidence, skeleton, found, kept, *rest)


def _looking_alike(pairs: Sequence[Pair], known: Sequence[Pair], given: Collection[int]) -> set[Edge]:
    """The pairs with panoramas of known poses that cover less than these cover of each other.

    They may only look alike: what connects panoramas with a scene is as near as neighbours in it.
    Args: known, the pairs between panoramas of known poses.
    """
    best = best_coverage(known)
    least = _AS_NEIGHBOURS * float(np.median(list(best.values()))) if best else 0.0
    return {it.between for it in pairs if it.coverage < least and not set(it.between).isdisjoint(given)}


def _loose(solution: Solution) -> set[int]:
    """The panoramas on the smaller side of a link that holds no scale, though points hold it; none without.

    No pair contradicts that: where a step seems to lead back, what follows fits in any size.
    """
    loose = next((it.smaller for it in solution.links if _LOOSE <= it.scale_error < np.inf), ())
    return {solution.sparse.rows[place] for place in loose}


def _unconfirmed(solution: Solution) -> set[int]:
    """The panoramas whose pose a single pair holds, or that stray from the order, unless that confirms it.

    A pair that looks alike gives a pose, too: only a second one shows that it is right. Neighbours that stray
    together do not confirm each other, and look-alikes none that match a neighbour in order elsewhere.
    """
    skeleton, found, evidence = solution.skeleton, solution.found, solution.evidence
    firm = skeleton.certain if skeleton.ordered or skeleton.given else frozenset[Edge]()
    group, held, leading = components(firm, len(evidence.rays)), Counter[int](), Counter[int]()
    torn = set[int]()  # groups that do not agree with a neighbour in order
    for pair in evidence.pairs:
        off = deviations(found, evidence, pair)
        groups = {int(group[row]) for row in pair.between}
        if pair.between in skeleton.tree or agrees(evidence, pair, off, CLOSE):
            held.update(pair.between)
            leading.update(groups if len(groups) > 1 else ())
        elif pair.apart == 1 and found.poses.keys() >= {*pair.between}:
            torn |= groups
    confirmed = {row for edge in firm for row in edge}
    alone = {row for row in found.poses if held[row] < 2} - confirmed
    if not skeleton.ordered:
        return alone
    sure = {row for row in confirmed if leading[group[row]] > 1 and group[row] not in torn}
    return alone | (_strays(found, firm) - sure)


def _strays(found: Posed, firm: Collection[Edge]) -> set[int]:
    """The panoramas that are far from those before and after them, which are near each other.

    Of places that look alike, as crossings do, several may stand on one, and confirm each other there.
    Args: firm, pairs that are certain: what one of these connects with others does not stray.
    """
    rows, strays = sorted(found.poses), set[int]()
    centers = found.centers(rows)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    for count in range(1, min(_ASTRAY, len(steps) - 1) + 1):
        least = np.minimum(steps[:-count], steps[count:])
        past = np.linalg.norm(centers[count + 1 :] - centers[: -count - 1], axis=1)
        for place in np.flatnonzero((least > _STRAY * np.median(steps)) & (past < least / 2)):
            run = set(rows[place + 1 : place + 1 + count])
            if not any(len(run & {*edge}) == 1 and found.poses.keys() >= {*edge} for edge in firm):
                strays |= run
    return strays
