"""A city of any size: districts that look different, squares, a river with bridges, towers; and a drive.

World: metres, z up. Streets are every `PITCH` metres in both directions, the middle is that of the city. A
block looks the same in every city that has it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.synthetic.buildings import TOWN, Style, church
from panolog.synthetic.district import BALLS, PITCH, courtyard, hills, houses, street_sides
from panolog.synthetic.facade import STOREY, Facade
from panolog.synthetic.furniture import tree
from panolog.synthetic.layout import AHEAD, GARDEN, ROAD
from panolog.synthetic.noise import Floats, fractal
from panolog.synthetic.paint import Grid, Ground, Plain, Slabs, mix, rgb
from panolog.synthetic.shapes import Convex, Paint, Shape, box, ellipsoid, moved

STEP = 5.6  # metres between panoramas, about
_DISTRICT = 2  # blocks along a side of a district
_RIVER, _EVERY = 13.0, 6  # metres from its middle to its quays; one row of blocks in so many is a river
_WATER, _BRIDGE = -2.4, 0.8  # metres: level of the water, and how thick a bridge is
_SQUARE, _TOWER = 0.12, 0.15  # share of the blocks
OVER_TOWERS = 25.0  # metres by which a flight is higher than over a district
_STONE = Plain(rgb("a59c8d"), 0.7, 2.5)
_STYLES = (
    TOWN,
    Style(
        storeys=(2, 3, 3, 4),
        walls=("e8e0cd", "d8cbb0", "c9bfa8", "ded6c6"),
        trims=("54606a", "6b5a4a", "39464c"),
        roofs=("4a5058", "565c66", "3f4850"),
        brick=0.05,
        shop=0.6,
    ),
    Style(
        storeys=(3, 4, 4, 5),
        walls=("8f3f2c", "a4513a", "7c3a2e", "94604a"),
        trims=("22302c", "d9d2c0", "2b3a4d"),
        roofs=("55504c", "6a625c"),
        brick=0.95,
        shop=0.35,
        steep=(0.25, 0.45),
    ),
    Style(
        storeys=(1, 1, 2),
        walls=("f0ece2", "e6eef0", "f2e4d4", "dfe8d8"),
        trims=("2f6a8a", "8a3b4a", "4c7a3e"),
        roofs=("3e6a8c", "7a3f3a", "467a5c"),
        brick=0.0,
        shop=0.1,
        steep=(0.8, 1.1),
    ),
)


@dataclass(frozen=True)
class _Banked:
    """The ground of a city; where it is steep, a wall."""

    ground: Grid

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        return mix(self.ground(points, normals), _STONE(points, normals), np.abs(normals[2]) < 0.5)


@dataclass(frozen=True)
class _Water:
    """Ripples of two blues, along x."""

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        x, y, _ = points
        ripples = 0.6 * fractal(x, 3 * y, 9.0) + 0.4 * fractal(y, x, 2.3)
        return mix(rgb("27485a"), rgb("6f97a0"), np.clip(2.2 * ripples - 0.6, 0, 1))


def size(panoramas: int) -> tuple[int, int]:
    """Blocks along x and y of a city whose streets so many panoramas fill, about `STEP` apart."""

    def far_off(columns: int, rows: int) -> float:
        return abs(float(np.log(_length(columns, rows) / (panoramas * STEP))))

    most = 2 + int(np.sqrt(panoramas * STEP / PITCH))
    return min(((n + more, n) for n, more in product(range(1, most), (0, 1))), key=lambda it: far_off(*it))


def _length(columns: int, rows: int) -> float:
    """Metres of all streets."""
    return PITCH * ((rows + 1) * columns + (columns + 1) * rows)


def city(columns: int, rows: int, seed: int) -> list[Shape]:
    """All solids of `columns` x `rows` blocks. The same arguments give the same city."""
    half = (columns * PITCH / 2, rows * PITCH / 2)
    rivers = [row for row in range(1, rows - 1) if row % _EVERY == 1]
    shapes = _ground(half, [(row + 0.5) * PITCH - half[1] for row in rivers], columns)
    for column, row in product(range(columns), range(rows)):
        random = np.random.default_rng([seed, 9, column, row])
        style = (seed + column // _DISTRICT + 2 * (row // _DISTRICT)) % len(_STYLES)
        inside = _bank(random) if row in rivers else _block(random, _STYLES[style])
        shapes += moved(inside + street_sides(random), column * PITCH - half[0], row * PITCH - half[1])
    return shapes + hills(np.random.default_rng([seed, 10]), max(half))


def _ground(half: tuple[float, float], rivers: Sequence[float], columns: int) -> list[Shape]:
    """The ground without end, cut by rivers along x with the y of their middles, their quays and bridges."""
    paint = _Banked(Grid(Ground(ROAD, GARDEN, ()), Slabs(ROAD), PITCH, half))
    ends = [-np.inf, *(y + side * _RIVER for y in rivers for side in (-1, 1)), np.inf]
    shapes: list[Shape] = [
        _land(low, high, 0.0, paint) for low, high in zip(ends[::2], ends[1::2], strict=True)
    ]
    if rivers:
        shapes.append(_land(-np.inf, np.inf, _WATER, _Water()))
    wide = GARDEN + 0.3
    for y, column in product(rivers, range(columns + 1)):
        x = column * PITCH - half[0]
        lower, upper = (x - wide, y - _RIVER, -_BRIDGE), (x + wide, y + _RIVER, 0.0)
        shapes.append(box(lower, upper, paint))
        for side in (-1, 1):
            edge = x + side * (wide - 0.15)
            shapes.append(_wall((edge - 0.15, y - _RIVER), (edge + 0.15, y + _RIVER), 1.0))
            if column < columns:
                quay = y + side * (_RIVER + 0.2)
                shapes.append(_wall((x + wide, quay - 0.2), (x + PITCH - wide, quay + 0.2), 0.8))
    return shapes


def _land(low: float, high: float, level: float, paint: Paint) -> Convex:
    """All below a level between two y."""
    planes = [((0, 0, 1), level), ((0, -1, 0), -low), ((0, 1, 0), high)]
    normals, offsets = zip(*[plane for plane in planes if np.isfinite(plane[1])], strict=True)
    origin = np.zeros(3, np.float32)
    return Convex(np.array(normals, np.float32), np.array(offsets, np.float32), origin, np.inf, paint)


def _wall(lower: tuple[float, float], upper: tuple[float, float], height: float) -> Shape:
    return box((*lower, 0), (*upper, height), _STONE)


def _block(random: np.random.Generator, style: Style) -> list[Shape]:
    kind = random.random()
    if kind < _SQUARE:
        return _square(random)
    inside = _tower(random, style) if kind < _SQUARE + _TOWER else courtyard(random)
    return houses(random, style) + inside


def _square(random: np.random.Generator) -> list[Shape]:
    """A paved square with trees around a church or a column."""
    middle, edge = PITCH / 2, 8.0
    shapes: list[Shape] = [box((edge, edge, 0), (PITCH - edge, PITCH - edge, 0.12), Slabs(ROAD))]
    for along in np.linspace(edge + 3, PITCH - edge - 3, 5).tolist():
        for x, y in ((along, edge + 3), (along, PITCH - edge - 3)):
            shapes += tree(random, x, y, float(random.uniform(4.5, 6.5)), BALLS)
    if random.random() < 0.5:
        return shapes + moved(church(), middle - 57.8, middle)
    for half, low, high in ((2.2, 0.12, 0.5), (1.6, 0.5, 0.9), (1.0, 0.9, 3.2)):
        shapes.append(box((middle - half, middle - half, low), (middle + half, middle + half, high), _STONE))
    shapes.append(ellipsoid((middle, middle, 7.2), (0.75, 0.75, 4.6), _STONE))
    shapes.append(ellipsoid((middle, middle, 12.2), (0.9, 0.9, 0.9), Plain(rgb("c9a14a"), 0.3)))
    return shapes


def _tower(random: np.random.Generator, style: Style) -> list[Shape]:
    """A tower in a courtyard."""
    middle, half, storeys = PITCH / 2, float(random.uniform(5.5, 7.0)), int(random.integers(9, 14))
    top = storeys * STOREY + 0.3
    wall, trim = (rgb(str(random.choice(colors))) for colors in (style.walls, style.trims))
    facade = Facade((middle, middle), (half, half), storeys, wall, trim, salt=int(random.integers(1000)))
    flat = Plain(rgb("6c6a68"), 0.4)
    return [
        box((middle - half, middle - half, 0), (middle + half, middle + half, top), facade),
        box((middle - half - 0.4,) * 2 + (top,), (middle + half + 0.4,) * 2 + (top + 0.5,), flat),
        box((middle - 2, middle - 2, top + 0.5), (middle + 2, middle + 1, top + 3.2), flat),
    ]


def _bank(random: np.random.Generator) -> list[Shape]:
    """Trees along both banks of a river."""
    shapes: list[Shape] = []
    for y, along in product((8.5, PITCH - 8.5), np.linspace(10, PITCH - 10, 5).tolist()):
        x = along + float(random.uniform(-1.5, 1.5))
        shapes += tree(random, x, y, float(random.uniform(5.5, 8.5)), BALLS)
    return shapes


def drive(columns: int, rows: int, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotations (count, 3, 3) and camera centres (count, 3) in metres, in all streets.

    First in those along x, then in those along y, to and fro, equally densely.
    """
    random = np.random.default_rng([seed, 11])
    lengths = np.repeat([columns * PITCH, rows * PITCH], [rows + 1, columns + 1])
    ends = np.cumsum(lengths)
    way = (np.arange(count) + random.uniform(0.3, 0.7, count)) / count * ends[-1]
    street = np.searchsorted(ends, way, side="right")
    at = way - ends[street] + lengths[street] / 2  # from the middle of the street
    ahead = np.where(street % 2 == 0, 1.0, -1.0)
    number = np.where(street <= rows, street - rows / 2, street - (rows + 1) - columns / 2)
    aside = number * PITCH + 0.5 * np.sin(way / 6.0) + random.uniform(-0.2, 0.2, count)
    along_x = street <= rows
    x, y = np.where(along_x, (ahead * at, aside), (aside, ahead * at))
    z = 2.0 + random.uniform(-0.04, 0.04, count)
    yaw = np.where(along_x, 0, 90) + np.where(ahead > 0, 0, 180) + random.uniform(-8, 8, count)
    tilt, roll = random.uniform(-1.5, 1.5, (2, count))
    turned = Rotation.from_euler("ZYX", np.stack([yaw, tilt, roll], axis=1), degrees=True)  # in the world
    return np.ascontiguousarray(AHEAD @ turned.inv().as_matrix()), np.stack([x, y, z], axis=1)
