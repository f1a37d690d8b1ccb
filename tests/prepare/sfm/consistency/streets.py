"""A walk along all streets of a grid, some of whose houses are copies: nothing is rendered."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from panolog.scene.projection import project_to_fractions
from tests.prepare.sfm.consistency.simulated import SIZE, Place, upright, write_place

Array = NDArray[np.float64]
_PITCH, _STEP = 56.0, 6.0  # metres between streets, and between panoramas
_WALL, _SEEN = 9.0, 22.0  # metres from the middle of a street to its fronts, and to points
_SHARE = 0.6  # of the points that a panorama could see, those that it has found
_NOISE = 0.5  # pixels
_FRONT, _FLOOR = 160, 90  # points of the houses of a street between two crossings, and of its ground
_AT = 7.0  # metres from a crossing, from where both streets are seen
_FEWEST = 15  # matches of a pair


@dataclass(frozen=True)
class Grid:
    """Streets along x and y, that cross."""

    columns: int  # streets along y
    rows: int  # streets along x
    copies: float = 0.0  # share of the blocks that look like one another
    points: float = 1.0  # of as many as usual
    seed: int = 0


def walk(grid: Grid) -> tuple[Array, NDArray[np.int64]]:
    """(K, 2) metres of panoramas along each street, the next one backwards, and (K,) the street of each."""
    centers, streets = [], []
    for axis, (count, others) in enumerate(((grid.rows, grid.columns), (grid.columns, grid.rows))):
        for number in range(count):
            along = np.arange(-_PITCH / 2 + _STEP / 2, (others - 0.5) * _PITCH, _STEP)
            along = along[:: -1 if number % 2 else 1]
            across = np.full(len(along), number * _PITCH)
            centers.append(np.stack([along, across] if axis == 0 else [across, along], axis=1))
            streets.append(np.full(len(along), axis * grid.rows + number))
    return np.concatenate(centers), np.concatenate(streets)


def town(folder: Path, grid: Grid) -> Place:
    """The panoramas of a walk along a grid of streets."""
    random = np.random.default_rng(grid.seed)
    where, looks, street_of = _points(random, grid)
    flat, own = walk(grid)
    count = len(flat)
    centers = np.column_stack([flat + random.normal(0, 0.2, (count, 2)), np.full(count, 1.6)])
    rotations = upright(random.uniform(-np.pi, np.pi, count))
    crossing = np.round(flat / _PITCH)
    at_crossing = np.linalg.norm(flat - crossing * _PITCH, axis=1) < _AT
    keypoints, rows = [], []
    for row in range(count):
        seen = np.linalg.norm(where - centers[row], axis=1) < _SEEN
        streets = [own[row]]
        if at_crossing[row]:
            c, r = crossing[row].astype(int).tolist()
            streets = [r, grid.rows + c]
        seen &= np.isin(street_of, streets)
        found = np.flatnonzero(seen & (random.random(len(where)) < _SHARE))
        pixels = project_to_fractions((where[found] - centers[row]) @ rotations[row].T) * SIZE
        keypoints.append(pixels + random.normal(0, _NOISE, pixels.shape))
        rows.append(found)
    pairs = {}
    for a in range(count):
        for b in range(a + 1, count):
            matches = _matches(rows[a], rows[b])
            if len(matches) < _FEWEST:
                matches = _matches(looks[rows[a]], looks[rows[b]])
            if len(matches) >= _FEWEST:
                pairs[a, b] = matches
    return write_place(
        folder,
        centers,
        keypoints,
        [looks[seen] for seen in rows],
        pairs,
        [np.zeros(len(seen), np.bool_) for seen in rows],
        random,
    )


def _matches(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """(M, 2) places of equal numbers in both."""
    return np.stack(np.intersect1d(one, other, return_indices=True)[1:], axis=1)


def _points(random: np.random.Generator, grid: Grid) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """(P, 3) points, what each looks like (P,), and the street from which it is seen (P,)."""
    front, floor = round(_FRONT * grid.points), round(_FLOOR * grid.points)
    design, last = _fronts(random, front), front
    where, looks, streets = [], [], []
    for axis, (count, others) in enumerate(((grid.rows, grid.columns), (grid.columns, grid.rows))):
        for number in range(count):
            for block in range(others + 1):
                copied = axis == 0 and random.random() < grid.copies  # turned, it would be mirrored
                ground = random.uniform([-_PITCH / 2, -_WALL, -0.1], [_PITCH / 2, _WALL, 0.3], (floor, 3))
                points = np.concatenate([design if copied else _fronts(random, front), ground])
                points += [(block - 0.5) * _PITCH, number * _PITCH, 0.0]
                where.append(points if axis == 0 else points[:, [1, 0, 2]])
                look = last + np.arange(len(points))
                look[: front if copied else 0] = np.arange(front if copied else 0)
                last += len(points)
                looks.append(look)
                streets.append(np.full(len(points), axis * grid.rows + number))
    return np.concatenate(where), np.concatenate(looks), np.concatenate(streets)


def _fronts(random: np.random.Generator, count: int) -> Array:
    """(N, 3) points of the houses on both sides of a street along x, between two crossings."""
    along, up = random.uniform(_WALL - _PITCH / 2, _PITCH / 2 - _WALL, count), random.uniform(0, 9, count)
    return np.column_stack([along, random.choice([-_WALL, _WALL], count) + random.normal(0, 0.5, count), up])
