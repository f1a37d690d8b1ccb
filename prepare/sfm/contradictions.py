"""Pairs of panoramas whose poses contradict their matches: the sign of a reconstruction misled by repetition.

Two panoramas that share more features than most neighbours do must see the same points. If their matches
became different points, one of the two poses is wrong: rows of equal windows have matched one window further
on, and from there everything fits again, one window off. Neither residuals nor weak links show that.
"""

from dataclasses import dataclass

import numpy as np
import pycolmap

from panolog.prepare.sfm.workspace import Workspace

_FEWEST = 50  # verified matches of a pair that counts
_STRONG = 0.5  # of the most matches of either panorama: weaker pairs may match repetitions without harm
_LOST = 1 / 3  # of the median share of matches that became common points in such pairs


@dataclass(frozen=True)
class Contradiction:
    """Two panoramas with many matches, of which few became common points."""

    between: tuple[int, int]  # rows of the panoramas
    matches: int  # verified
    points: int  # common ones, from these matches


def find_contradictions(work: Workspace, model: pycolmap.Reconstruction) -> list[Contradiction]:
    """The contradictions in a reconstruction, the strongest first."""
    pairs = _pairs(work, model)
    most: dict[int, int] = {}
    for pair in pairs:
        for row in pair.between:
            most[row] = max(most.get(row, 0), pair.matches)
    strong = [pair for pair in pairs if pair.matches >= _STRONG * min(most[row] for row in pair.between)]
    if not strong:
        return []
    usual = float(np.median([pair.points / pair.matches for pair in strong]))
    found = [pair for pair in strong if pair.points < _LOST * usual * pair.matches]
    return sorted(found, key=lambda pair: -pair.matches)


def _pairs(work: Workspace, model: pycolmap.Reconstruction) -> list[Contradiction]:
    """All pairs of posed panoramas with at least `_FEWEST` verified matches."""
    row_of = {number: row for row, number in enumerate(work.ids())}
    point_of = {
        number: np.array([it.point3D_id if it.has_point3D() else -1 for it in model.image(number).points2D])
        for number in model.reg_image_ids()
    }
    found = []
    with pycolmap.Database.open(work.database) as database:
        ids, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(ids, geometries, strict=True):
        one, other = pycolmap.pair_id_to_image_pair(pair)
        matches = np.asarray(geometry.inlier_matches, np.int64)
        if len(matches) >= _FEWEST and one in point_of and other in point_of:
            first, second = point_of[one][matches[:, 0]], point_of[other][matches[:, 1]]
            together = int(((first == second) & (first >= 0)).sum())
            found.append(Contradiction((row_of[one], row_of[other]), len(matches), together))
    return found
