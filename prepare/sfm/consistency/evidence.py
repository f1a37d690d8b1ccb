"""Verified pairs of panoramas, and how much of what each sees is found in the other.

Two places that look alike share their facades, often more features than two neighbours do. But a panorama
sees everything around it: ground, sky and what stands between. Where the features of one panorama that are
found in others have no match in this pair, though they lie all around, the pair does not show one place.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.projection import rays_of_fractions

Array = NDArray[np.float64]
FEWEST = 15  # matches of a pair that counts: COLMAP's own bound
LIKE_OTHERS = 0.75  # of the median coverage of neighbours: below it, they may only look alike
_BANDS = np.sin(np.deg2rad([-30.0, -10.0, 10.0, 30.0]))  # of latitude: the border of five rows of cells
_AROUND = 6  # cells in a row
CELLS = _AROUND * (len(_BANDS) + 1)
_FULL = 6  # features of a cell that counts
_SEVERAL = 3  # rays of a cell
_FOUND = 0.25  # of the pair's share of matches: a cell with less lacks them


@dataclass(frozen=True, eq=False)
class Pair:
    """Two panoramas and their verified matches."""

    between: tuple[int, int]  # rows of the panoramas, ascending
    matches: NDArray[np.int64]  # (M, 2) rows of their features
    coverage: float = 0.0  # share of the directions with features in which the pair has matches
    rivalled: bool = False  # by another geometry, which explains about as much
    moved: NDArray[np.bool_] | None = None  # (M,) which matches no rotation alone explains; None is all
    parallax: float = 0.0  # degrees between directions of these, but for the rotation: their median
    share: float = 0.0  # of the features that any pair has found in a panorama, those that this one has

    @property
    def telling(self) -> NDArray[np.int64]:
        """(T, 2) the matches that say where the panoramas stand: what is far away looks alike everywhere."""
        return self.matches if self.moved is None else self.matches[self.moved]

    @property
    def apart(self) -> int:
        """How many panoramas one is after the other."""
        return self.between[1] - self.between[0]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What all pairs are judged by."""

    rays: tuple[Array, ...]  # of each panorama (N, 3) directions of its features in camera axes
    pairs: tuple[Pair, ...]

    def directions(self, pair: Pair) -> tuple[Array, Array]:
        """(M, 3) directions of the matches of a pair, in camera axes of the first panorama and the second."""
        one, other = (self.rays[row][pair.matches[:, side]] for side, row in enumerate(pair.between))
        return one, other

    def among(self, rows: Collection[int]) -> "Evidence":
        """The pairs of these panoramas alone."""
        inside = set(rows)
        return replace(self, pairs=tuple(pair for pair in self.pairs if inside.issuperset(pair.between)))


def read_evidence(work: Workspace, size: tuple[int, int]) -> Evidence:
    """The verified pairs in a database, with their coverage; size, (width, height) of the panoramas."""
    ids = work.ids()
    row_of = {number: row for row, number in enumerate(ids)}
    with pycolmap.Database.open(work.database) as database:
        rays = tuple(
            rays_of_fractions(np.asarray(database.read_keypoints(number)[:, :2], np.float64) / size)
            for number in ids
        )
        found, geometries = database.read_two_view_geometries()
    pairs = []
    for number, geometry in zip(found, geometries, strict=True):
        one, other = (row_of[it] for it in pycolmap.pair_id_to_image_pair(number))
        matches = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
        if len(matches) >= FEWEST:
            flipped = one > other
            pairs.append(Pair((min(one, other), max(one, other)), matches[:, ::-1] if flipped else matches))
    pairs.sort(key=lambda pair: pair.between)
    return Evidence(rays, tuple(with_coverage(rays, pairs)))


def best_coverage(pairs: Iterable[Pair]) -> dict[int, float]:
    """The greatest coverage of the pairs of each panorama, by its row."""
    best = dict[int, float]()
    for pair in pairs:
        for row in pair.between:
            best[row] = max(best.get(row, 0.0), pair.coverage)
    return best


def with_coverage(rays: Sequence[Array], pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs with their coverage; what a panorama shares with any of them is what can be found."""
    cells = near_cells(rays, pairs)
    known = [by_cell(own) for own in cells]
    return [
        replace(
            pair,
            coverage=min(
                covered(known[row], by_cell(cells[row][pair.telling[:, side]]))
                for side, row in enumerate(pair.between)
            )
            * (len(pair.telling) >= FEWEST),
            share=len(pair.telling) / max(1, min(int(known[row].sum()) for row in pair.between)),
        )
        for pair in pairs
    ]


def near_cells(rays: Sequence[Array], pairs: Iterable[Pair]) -> list[NDArray[np.int64]]:
    """The cell of each feature (N,) of each panorama; `CELLS` if no pair has found it near the camera."""
    near = [np.zeros(len(own), np.bool_) for own in rays]
    for pair in pairs:
        for side, row in enumerate(pair.between):
            near[row][pair.telling[:, side]] = True
    return [np.where(found, _cell(own), CELLS) for own, found in zip(rays, near, strict=True)]


def by_cell(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(CELLS,) how many of these features are in each cell."""
    return np.bincount(cells, minlength=CELLS + 1)[:CELLS]


def covered(known: NDArray[np.int64], matched: NDArray[np.int64]) -> float:
    """The share of the cells with features that any pair has found in which this pair has some."""
    full = known >= _FULL
    if not full.any():
        return 0.0
    usual = matched.sum() / known.sum()
    return float((matched[full] > _FOUND * usual * known[full]).mean())


def directions(rays: Array) -> int:
    """In how many parts of the sphere there are several of these rays (N, 3)."""
    return int((by_cell(_cell(rays)) >= _SEVERAL).sum())


def _cell(rays: Array) -> NDArray[np.int64]:
    """(N,) of directions (N, 3): one of five bands of latitude, and of six parts around."""
    around = np.arctan2(rays[:, 0], rays[:, 2]) / (2 * np.pi) + 0.5
    column = np.minimum((around * _AROUND).astype(np.int64), _AROUND - 1)
    return np.digitize(rays[:, 1], _BANDS) * _AROUND + column
