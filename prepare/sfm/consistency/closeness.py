"""Whether two panoramas that the poses put next to each other share a front alone.

Where a walk jumps to a look-alike and what lies between is missing, all pairs that lead across the joint
agree. But the joint puts panoramas next to each other that share in some directions what neighbours share,
and in others, as on the ground, nothing. In another light, panoramas of one place share less everywhere.

What a panorama sees near it counts, however it was matched: the closer two stand, the fewer of their matches
show a motion.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.sfm.consistency.evidence import CELLS, Evidence, Pair, by_cell, covered, near_cells

Counts = NDArray[np.int64]
_MUCH = 0.75  # of the usual share: two panoramas with as much, in all or in some directions, are in one light
_COVERED = 0.85  # of the usual coverage: with as much, they show one place in whatever light
_SOME = 0.1  # of the features must lie in directions that share much, or nothing is known of a front
_BELOW = CELLS // 5 * 3  # the first cell of the two lower bands of latitude
_BARE = 0.05  # of the features that are below, at most: the ground shows nothing
_MOVED = 0.9  # of the usual share of features whose matches show a motion


class Closeness:
    """What panoramas that stand close together share, measured by pairs that carry a reconstruction."""

    def __init__(self, evidence: Evidence, carrying: Sequence[Pair]) -> None:
        """Args: carrying, the pairs that carry the reconstruction."""
        self._cells = near_cells(evidence.rays, evidence.pairs)
        self._known = [by_cell(cells) for cells in self._cells]
        found = [self._found(pair) for pair in carrying]
        usual = [[_share(it), _coverage(it), pair.share] for it, pair in zip(found, carrying, strict=True)]
        self._share, self._coverage, self._moved = np.median(usual or [[0.0] * 3], axis=0).tolist()
        below = [known[_BELOW:].sum() / max(1, known.sum()) for known in self._known]
        self._bare = float(np.median(below or [0.0])) < _BARE

    def judge(self, pair: Pair) -> bool | None:
        """Whether a pair that agrees and stands close shows one place; None if that is unclear.

        It does not if it shares a front alone, as neighbours share it, which is seen in one light. In a bare
        place, whose ground shows nothing, look-alikes differ by the number of matches that show a motion at
        most, and nothing shows one place.
        """
        if self._bare:
            return False if pair.share < _MOVED * self._moved else None
        found = self._found(pair)
        if _share(found) >= _MUCH * self._share or _coverage(found) >= _COVERED * self._coverage:
            return True
        in_one_light = np.mean([_dense(*it, _MUCH * self._share) for it in found]) >= _SOME
        return False if in_one_light else None

    def _found(self, pair: Pair) -> list[tuple[Counts, Counts]]:
        """Counts near features in each direction, known and matched by the pair, in each of its panoramas."""
        return [
            (self._known[row], by_cell(self._cells[row][pair.matches[:, side]]))
            for side, row in enumerate(pair.between)
        ]


def _share(found: Sequence[tuple[Counts, Counts]]) -> float:
    """The matched share of the known features, the mean of both panoramas."""
    return float(np.mean([matched.sum() / max(1, known.sum()) for known, matched in found]))


def _coverage(found: Sequence[tuple[Counts, Counts]]) -> float:
    """The share of the directions that are matched, of the panorama in which it is less."""
    return min(covered(known, matched) for known, matched in found)


def _dense(known: Counts, matched: Counts, least: float) -> float:
    """The share of features that are in directions in which at least this share is matched."""
    return float(known[matched >= least * known].sum() / max(1, known.sum()))
