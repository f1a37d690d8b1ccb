"""Pairs of panoramas whose poses contradict their matches: the sign of a reconstruction misled by repetition.

Two panoramas that share as much of the sphere as neighbours do must see the same points. If those of one are
elsewhere in the other, one of the two poses is wrong: rows of equal windows have matched one window further
on, and from there everything fits again, one window off. Neither residuals nor weak links show that.
Nor does a single pair where a walk jumps to a look-alike, and what lies between is missing: all that lead
across agree. But they put panoramas side by side that share a front alone (`closeness.py`).

In the order of capture, neighbours are known. A pair that is farther off than a walk along them can drift
only looks alike, but for where the order was followed only by a guess on the way from one to the other; and
so does one if more is shared by pairs that agree across each step of that way. What agrees across a guess may
be misled as the guess is, so only a guess with far more matches outweighs what contradicts it.
Without an order, a pair only looks alike if it covers clearly less than each pair on the best way from one
to the other along pairs that agree.

Neighbours may be misled themselves, by a step past equal windows that looks like one back. Where pairs that
agree share more across that step than the two do, these contradict nothing.

Where even neighbours have a second geometry that explains about as much as the first, nothing contradicts
either. Single ones are decided by what lies around; where there are many, the whole is not trusted.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.agreement import (
    Posed,
    agrees,
    apart,
    deviations,
    has_moved,
    judged,
)
from panolog.prepare.sfm.consistency.closeness import Closeness
from panolog.prepare.sfm.consistency.evidence import Evidence, Pair
from panolog.prepare.sfm.consistency.motion import Motion
from panolog.prepare.sfm.consistency.skeleton import (
    Edge,
    Skeleton,
    components,
    tree_path,
    tree_paths,
    widest_tree,
)

_AS_NEIGHBOURS = 0.9  # of the median coverage of the pairs that carry the reconstruction
_MARGIN = 0.85  # of the least coverage on the way between two without an order: with less they look alike
_SHARED = 0.75  # of the median share of features of the pairs that carry: copies of houses stand apart
_CLOSE = 0.5  # of the median step: who stands closer shares more than a front, or is a look-alike
_DRIFTED = 20.0  # degrees that a walk may be off where it returns
_RIVALLED = 0.3  # of the edges of the tree that may have a rival
_FEW = 0.25  # of the matches of a guess: what has fewer looks alike, whatever the guess does
_EQUAL = 3  # guesses that are refuted together, as nothing says which is wrong
_MOST = 0.02  # contradictions for each panorama, but for those of the tree, of which there may be none
_MOST_GUESSED = 0.005  # the same where the order was followed by a guess: a wrong one leads to more

MotionOf = Callable[[Pair], Motion | None]
Kept = dict[Edge, NDArray[np.int64]]  # matches (M, 2) of the pairs that are mapped


@dataclass(frozen=True)
class Contradiction:
    """Two panoramas with many matches, of which few fit their poses."""

    between: Edge  # rows of the panoramas
    matches: int  # verified ones, of which a point is known
    points: int  # of these, whose points are where they are seen; all of them, if they share a front alone

    @property
    def reason(self) -> str:
        """What the two share that contradicts their poses, as the end of a sentence."""
        if self.points < self.matches:
            return f"share {self.matches} features, but {self.points} fit their poses"
        return f"share {self.matches} features on one side alone, though they would stand close together"


def find_contradictions(
    evidence: Evidence, skeleton: Skeleton, found: Posed, bound: float, motion: MotionOf
) -> list[Contradiction]:
    """The contradictions in a reconstruction, the strongest first.

    Args: bound, degrees that points may be off; motion, of the camera between the panoramas of a pair, by
        which pairs that carry the reconstruction are judged where too few of their points are known.
    """
    of_tree = [pair for pair in evidence.pairs if pair.between in skeleton.tree]
    usual = [[it.coverage, it.share, it.parallax] for it in of_tree] or [[0.0] * 3]
    covered, share, parallax = np.median(usual, axis=0).tolist()
    steps = [apart(found, it.between) for it in of_tree if found.poses.keys() >= set(it.between)]
    near = _CLOSE * float(np.median(steps or [0.0]))
    agreeing, own, against = _verdicts(evidence, skeleton, found, bound, motion)
    across = _shared_across(skeleton, agreeing) if skeleton.ordered else {}
    outvoted = {it.between for it, _ in own if it.share < across.get(it.between, 0.0)} & skeleton.certain
    contradictions = [it for _, it in own if it.between not in outvoted]
    close = [pair for pair in agreeing if apart(found, pair.between) < near]
    contradictions += _fronts(Closeness(evidence, of_tree), skeleton, close, of_tree) if close else []
    sides = components(skeleton.certain, len(evidence.rays))
    known = [Pair(edge, np.empty((0, 2), np.int64), 1.0) for edge in sorted(skeleton.star)]
    way = widest_tree([*agreeing, *known], len(evidence.rays))
    shares = {pair.between: pair.share for pair in agreeing}
    likely = []
    for pair, fit, median in against:
        guessed = sides[pair.between[0]] != sides[pair.between[1]]
        if skeleton.ordered:
            counts = pair.coverage >= _AS_NEIGHBOURS * covered and (guessed or median < _DRIFTED)
            usual_share = share
        else:
            path = tree_path(way, pair.between)
            least = min((way[edge] for edge in path), default=0.0)
            counts = pair.coverage >= _MARGIN * least
            usual_share = min([share, *(shares[edge] for edge in path if edge in shares)])
        nearer = max(1.0, parallax / pair.parallax) if pair.parallax else 1.0  # shares more, if it is true
        if counts and pair.share >= _SHARED * usual_share * np.sqrt(nearer):
            likely.append((pair, fit))
    if likely and skeleton.ordered:
        likely = _leading_across_doubt(likely, skeleton, across, of_tree)
    contradictions += [fit for _, fit in likely]
    return sorted(contradictions, key=lambda it: (it.points - it.matches, it.between))


def _verdicts(
    evidence: Evidence, skeleton: Skeleton, found: Posed, bound: float, motion: MotionOf
) -> tuple[list[Pair], list[tuple[Pair, Contradiction]], list[tuple[Pair, Contradiction, float]]]:
    """The pairs that agree, those of the tree that do not, and the others that do not.

    The others come with the median of the degrees that points are off. What nothing judges is left out.
    """
    agreeing, own = list[Pair](), list[tuple[Pair, Contradiction]]()
    against = list[tuple[Pair, Contradiction, float]]()
    for pair in evidence.pairs:
        carries = pair.between in skeleton.tree
        off = deviations(found, evidence, pair)
        fits = agrees(evidence, pair, off, bound)
        if fits is None:
            if carries and not has_moved(found, pair.between, motion(pair)):
                own.append((pair, Contradiction(pair.between, len(pair.matches), 0)))
        elif fits:
            agreeing.append(pair)
        else:
            off = off[judged(pair, off)]
            fit = Contradiction(pair.between, len(off), int((off <= bound).sum()))
            if carries:
                own.append((pair, fit))
            else:
                against.append((pair, fit, float(np.median(off))))
    return agreeing, own, against


def _leading_across_doubt(
    likely: Sequence[tuple[Pair, Contradiction]],
    skeleton: Skeleton,
    across: Mapping[Edge, float],
    of_tree: Sequence[Pair],
) -> list[tuple[Pair, Contradiction]]:
    """The pairs of a walk in order that do not only look alike.

    Where a motion is wrong, all pairs that lead across it contradict, but for those that are misled alike.
    Args: across, how much the pairs that agree share across each edge.
    """
    against = _shared_across(skeleton, [pair for pair, _ in likely])
    outvoted = {edge for edge in skeleton.tree if against[edge] > across[edge]}
    telling = {it.between: len(it.telling) for it in of_tree if it.between in skeleton.guessed}
    ways = tree_paths(skeleton.edges, [pair.between for pair, _ in likely])
    return [
        (pair, fit)
        for (pair, fit), way in zip(likely, ways, strict=True)
        if not way
        or outvoted.intersection(way)
        or fit.matches >= _FEW * min((telling[edge] for edge in way if edge in telling), default=np.inf)
    ]


def _fronts(
    closeness: Closeness, skeleton: Skeleton, close: Sequence[Pair], of_tree: Sequence[Pair]
) -> list[Contradiction]:
    """The pairs that agree and stand close, but share a front alone, as across a joint of look-alikes.

    Where shadows have moved, single pairs do, too, but others show one place across all of the way between:
    close ones, and those of the tree but for guesses.
    """
    verdicts = [closeness.judge(pair) for pair in close]
    alike = [pair for pair, verdict in zip(close, verdicts, strict=True) if verdict is False]
    if not alike:
        return []
    same = [pair.between for pair, verdict in zip(close, verdicts, strict=True) if verdict]
    firm = [pair for pair in of_tree if pair.between not in skeleton.guessed]
    same += [pair.between for pair in firm if closeness.judge(pair)]
    sound = {edge for way in tree_paths(skeleton.edges, same) for edge in way}
    ways = tree_paths(skeleton.edges, [pair.between for pair in alike])
    doubted = [it for it, way in zip(alike, ways, strict=True) if not way or not sound.issuperset(way)]
    return [Contradiction(pair.between, len(pair.telling), len(pair.telling)) for pair in doubted]


def _shared_across(skeleton: Skeleton, pairs: Sequence[Pair]) -> dict[Edge, float]:
    """How much the pairs share in all that lead across each edge between panoramas; it is one of them."""
    shared = dict.fromkeys(skeleton.edges, 0.0)
    for pair, way in zip(pairs, tree_paths(skeleton.edges, [it.between for it in pairs]), strict=True):
        for edge in way:
            shared[edge] += pair.share
    return shared


def is_repetitive(skeleton: Skeleton, rows: Collection[int]) -> bool:
    """Whether too many of the pairs that carry poses of panoramas have a geometry that rivals theirs."""
    tree = [edge for edge in skeleton.tree if set(edge) <= set(rows)]
    return len(skeleton.rivalled.intersection(tree)) > _RIVALLED * len(tree)


def is_trusted(contradictions: Sequence[Contradiction], skeleton: Skeleton, rows: Collection[int]) -> bool:
    """Whether poses of panoramas can be used in spite of contradictions and of geometries that have rivals.

    Where the order was followed by a guess, or the tree does not connect them, there may be no contradiction
    in a walk of less than 200; the tree has to connect them with poses that are known.
    """
    sides = components(skeleton.among(rows).edges, max(rows) + 1)
    guessed = len({int(sides[row]) for row in rows}) > 1
    if guessed and skeleton.given:
        return False
    broken = any(it.between in skeleton.tree for it in contradictions)
    guessed |= any(edge in skeleton.tree and set(edge) <= set(rows) for edge in skeleton.guessed)
    most = _MOST_GUESSED * len(rows) if guessed else max(1, _MOST * len(rows))
    return len(contradictions) <= most and not broken and not is_repetitive(skeleton, rows)


def doubted_guesses(contradictions: Sequence[Contradiction], skeleton: Skeleton) -> set[Edge]:
    """The guesses that contradictions lead across."""
    return set[Edge]().union(*_guesses([it.between for it in contradictions], skeleton))


def refuted_guesses(contradictions: Sequence[Contradiction], skeleton: Skeleton, kept: Kept) -> set[Edge]:
    """The guesses that contradictions lead across: as few as explain these, where they have more matches.

    Each is the one that most lead across that none explains yet, of several that which fewest of the pairs
    that agree do. A large walk has many guesses, and few are wrong: where those of a whole way are refuted,
    what takes their place is wrong. So none is where more than a few are as likely. A guess with more
    matches than what contradicts it is no look-alike, unless it contradicts itself.

    Args: kept, the pairs that agree.
    """
    ways = _guesses([it.between for it in contradictions], skeleton)
    if not any(ways):
        return set()
    agreeing = Counter(edge for way in _guesses(list(kept), skeleton) for edge in way)
    left, refuted, doubt = ways, set[Edge](), Counter[Edge]()
    while left := [way for way in left if way]:
        against = Counter(edge for way in left for edge in way)
        first = min((-count, agreeing[edge]) for edge, count in against.items())
        likely = {edge for edge, count in against.items() if (-count, agreeing[edge]) == first}
        if len(likely) <= _EQUAL:
            refuted |= likely
        left = [way for way in left if not way & likely]
    for it, way in zip(contradictions, ways, strict=True):
        doubt.update(dict.fromkeys(way, it.matches))
    own = {it.between for it in contradictions}
    return {edge for edge in refuted if edge in own or doubt[edge] > len(kept.get(edge, ()))}


def _guesses(pairs: Sequence[Edge], skeleton: Skeleton) -> list[frozenset[Edge]]:
    """The guesses on the way between the panoramas of each pair."""
    return [skeleton.guessed.intersection(way) for way in tree_paths(skeleton.edges, pairs)]


def consistent_part(
    rows: Sequence[int],
    contradictions: Sequence[Contradiction],
    skeleton: Skeleton,
    evidence: Evidence,
) -> list[int]:
    """The largest part of panoramas without a contradiction between those that the tree connects, ascending.

    The tree is cut where it is weakest between two that contradict each other, and the smaller side left out;
    where too many geometries have rivals, at all of these before. Panoramas whose poses are known stay, and
    the cut is at each guess on the way.
    """
    coverage = {pair.between: pair.coverage for pair in evidence.pairs}
    part, star, known = set(rows), skeleton.star, sorted(skeleton.given)[:1]
    tree = {edge for edge in skeleton.tree if set(edge) <= part}
    carried = {row for edge in tree for row in edge}
    if is_repetitive(skeleton, rows):
        tree -= skeleton.rivalled
        part = _largest(part, tree | star, known or sorted(part), len(evidence.rays))
    for it in contradictions:
        if not set(it.between) <= part:
            continue
        path = [edge for edge in tree_path(tree | star, it.between) if edge in tree]
        if not path:
            loose = set(it.between) - skeleton.given - carried
            part -= {max(loose)} if loose else set()  # the tree has the others on different sides
            continue
        guesses = skeleton.guessed.intersection(path) if known else frozenset()
        tree -= guesses or {min(path, key=lambda edge: (coverage[edge], edge))}
        part = _largest(part, tree | star, known or it.between, len(evidence.rays))
        tree = {edge for edge in tree if set(edge) <= part}
    return sorted(part)


def _largest(part: set[int], tree: set[Edge], ends: Sequence[int], count: int) -> set[int]:
    """The rows of a part that a tree connects with one of the ends: the most, of equally many the first."""
    of = components(tree, count)
    return max(({row for row in part if of[row] == of[end]} for end in ends), key=len)
