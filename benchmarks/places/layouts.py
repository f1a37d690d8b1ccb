"""What stands where in places whose houses all look the same, and how a camera walks through them.

World: metres, z up. A row of houses consists of copies of one house, to the last pixel of their walls: only
the ground, the sky and the perspective tell one from the other. In a `bare` place not even ground and sky do.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.buildings import Style, house
from panolog.synthetic.paint import Ground, Plain, rgb
from panolog.synthetic.shapes import Convex, Shape, moved

Array = NDArray[np.float64]
_HALF = 4.0  # metres, of a house's front
_FRONT = 8.3  # metres from y = 0 to the middle of where `house` puts its front
_STREET = 6.0  # metres from the middle of a street to the fronts
STYLE = Style(storeys=(3,), brick=0.0, shop=0.0)


@dataclass(frozen=True)
class Layout:
    """A place: its solids, and the corners of the way through it."""

    shapes: Callable[[int, bool], list[Shape]]  # of a seed, and whether it is bare
    ways: Sequence[Sequence[tuple[float, float]]]  # (x, y) of the corners of each way, one after the other
    step: float  # metres between panoramas


def path(layout: Layout, seed: int) -> tuple[Array, Array]:
    """Camera centres (K, 3) and headings (K,) in radians along the ways, with rounded corners."""
    random = np.random.default_rng([seed, 21])
    parts = [_walk(np.array(way, np.float64), layout.step) for way in layout.ways]
    places, headings = (np.concatenate(them) for them in zip(*parts, strict=True))
    count = len(places)
    places = places + random.uniform(-0.12, 0.12, (count, 2))
    heights = 1.65 + random.uniform(-0.04, 0.04, count)
    return np.column_stack([places, heights]), headings + np.deg2rad(random.uniform(-5, 5, count))


def _walk(corners: Array, step: float) -> tuple[Array, Array]:
    """Places (K, 2) every `step` metres along a polyline, and the headings (K,) there, both smoothed."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    along = np.linspace(0, ends[-1], round(ends[-1] / step) + 1)
    fine = np.linspace(-1.2, 1.2, 25)
    at = np.clip(along[:, None] + fine, 0, ends[-1])
    places = np.stack([np.interp(at, ends, corners[:, axis]).mean(axis=1) for axis in (0, 1)], axis=1)
    before, after = np.clip(along - 0.6, 0, ends[-1]), np.clip(along + 0.6, 0, ends[-1])
    way = np.stack(
        [np.interp(after, ends, corners[:, k]) - np.interp(before, ends, corners[:, k]) for k in (0, 1)],
        axis=1,
    )
    return places, np.arctan2(way[:, 1], way[:, 0])


def _row(seed: int, count: int, front: float, x: float = 0.0) -> list[Shape]:
    """`count` equal houses around `x` on the side +1 of y = 0, whose fronts are at y = `front`."""
    shapes: list[Shape] = []
    for number in range(count):
        one = house(np.random.default_rng([seed, 20]), 0.0, 1.0, _HALF - 0.1, STYLE)
        middle = x + (number - (count - 1) / 2) * 2 * _HALF
        shapes += moved(one, middle, front - _FRONT)
    return shapes


def _ground(bare: bool) -> Shape:
    up, level, origin = np.array([[0, 0, 1]], np.float32), np.zeros(1, np.float32), np.zeros(3, np.float32)
    paint = Plain(rgb("8d867a"), 0.0) if bare else Ground(0.0, 0.0, ())
    return Convex(up, level, origin, np.inf, paint)


def _square(seed: int, bare: bool) -> list[Shape]:
    """Four equal sides around 40 x 40 metres."""
    shapes = [_ground(bare)]
    for quarters in range(4):
        shapes += moved(_row(seed, 5, 20.0), 0.0, 0.0, quarters)
    return shapes


def _block(seed: int, houses: tuple[int, int], x: float, y: float) -> list[Shape]:
    """A block around (x, y) with so many houses along x and along y: equal fronts on all sides."""
    shapes: list[Shape] = []
    for quarters in range(4):
        count, away = (houses[quarters % 2], houses[(quarters + 1) % 2])
        # The row's front faces -y; the block's side is turned so that it faces outward.
        side = moved(_row(seed, count, 0.0), 0.0, -away * _HALF)
        shapes += moved(side, 0.0, 0.0, quarters)
    return moved(shapes, x, y)


def _blocks(columns: int, rows: int, houses: tuple[int, int]) -> Callable[[int, bool], list[Shape]]:
    """A grid of blocks around the origin, with streets between and around them."""
    pitch = [2 * _HALF * count + 2 * _STREET for count in houses]

    def build(seed: int, bare: bool) -> list[Shape]:
        shapes = [_ground(bare)]
        for column in range(columns):
            for row in range(rows):
                x, y = (column - (columns - 1) / 2) * pitch[0], (row - (rows - 1) / 2) * pitch[1]
                shapes += _block(seed, houses, x, y)
        return shapes

    return build


def _street(mirrored: bool, closed: bool = False) -> Callable[[int, bool], list[Shape]]:
    """Ten houses on each side of a street along x; the other side is the same, or another house's copies."""

    def build(seed: int, bare: bool) -> list[Shape]:
        shapes = [_ground(bare), *_row(seed, 10, _STREET)]
        shapes += moved(_row(seed if mirrored else seed + 1, 10, _STREET), 0.0, 0.0, 2)
        if closed:
            shapes += moved(_row(seed, 2, 10 * _HALF + 2.0), 0.0, 0.0, 3)
        return shapes

    return build


def _ring(half: float, start: float) -> list[tuple[float, float]]:
    """A square way around the origin, closed, from the middle of a side on."""
    return [
        (start, -half), (half, -half), (half, half), (-half, half), (-half, -half), (start, -half)
    ]  # fmt: skip


_P = 2 * _HALF * 2 + 2 * _STREET  # metres between the streets of the grid
LAYOUTS: dict[str, Layout] = {
    "square": Layout(_square, [[*_ring(14.0, 0.0), (0.0, -8.0), *_ring(8.0, 0.0)[1:]]], 2.6),
    "grid": Layout(
        _blocks(2, 2, (2, 2)),
        [[(-_P, -_P), (_P, -_P), (_P, _P), (0, _P), (0, -_P), (-_P, -_P), (-_P, 0), (_P, 0)]],
        3.2,
    ),
    "loops": Layout(
        _blocks(2, 1, (2, 2)),
        [
            [
                (0, -_P / 2), (_P, -_P / 2), (_P, _P / 2), (0, _P / 2), (0, -_P / 2), (-_P, -_P / 2),
                (-_P, _P / 2), (0, _P / 2),
            ]
        ],
        2.8,
    ),
    "dead-end": Layout(_street(False, True), [[(-20, 0.8), (30, 0.8), (30, -0.8), (-20, -0.8)]], 2.0),
    "mirrored": Layout(_street(True), [[(-32, 0.5), (-10, -0.5), (10, 0.5), (32, -0.5)]], 1.6),
    "street": Layout(_street(False), [[(-32, 0.5), (-10, -0.5), (10, 0.5), (32, -0.5)]], 1.6),
}  # fmt: skip
