"""A city of any size: districts that look different, squares, a river with bridges, towers; and a drive.

World: metres, z up. Streets are every `PITCH` metres in both directions; the crossing number (c, r) is at
(c, r) * PITCH, and the block (c, r) is north-east of it. A block looks the same in every city that has it.
"""

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.synthetic.buildings import Style, church
from panolog.synthetic.district import BALLS, PITCH, courtyard, hills, houses, street_sides
from panolog.synthetic.facade import STOREY, Facade
from panolog.synthetic.furniture import tree
from panolog.synthetic.layout import AHEAD, GARDEN, ROAD
from panolog.synthetic.noise import Floats, fractal
from panolog.synthetic.paint import Bools, Color, Grid, Ground, Plain, Slabs, Stripes, mix, rgb
from panolog.synthetic.shapes import Convex, Paint, Plane, Shape, box, convex, ellipsoid, moved

PER_CROSSING = 18.75  # panoramas: 4, 16 and 64 crossings are those of 75, 300 and 1,200
STEP = 2 * PITCH / PER_CROSSING  # metres between panoramas: a crossing has 2 * PITCH of streets
OVER_TOWERS = 25.0  # metres by which a flight is higher than over a district
_MIDDLE, _QUAY = PITCH / 2, 13.0  # metres, of the river in the blocks (c, 0): its middle, and half its width
_WATER, _BRIDGE = -2.4, 0.7  # metres: level of the water, and how thick a bridge is
_DISTRICT = 2  # blocks along a side of a district
_STONE = Plain(rgb("a59c8d"), 0.7, 2.5)
_CLOTHS = ("b23a32", "2f5f8a", "3f7a4a", "c98b2c")
_STYLES = (
    Style(  # an old town
        storeys=(2, 3, 3, 4),
        walls=("e8d9b8", "dcb98a", "d9a27c", "e6e0d0", "c9b08a", "d8c0a8"),
        roofs=("a8492f", "b4613c", "93432f"),
        brick=0.1,
        shop=0.6,
        steep=(0.8, 1.05),
        gaps=(0.3, 0.3, 0.9),
    ),
    Style(  # grey and stately
        storeys=(4, 5, 5, 6),
        walls=("e8e4da", "d5d2ca", "c7ccd0", "dfe3e2"),
        trims=("54606a", "39464c", "4a5a78"),
        roofs=("4a5058", "565c66", "3f4850"),
        brick=0.0,
        shop=0.5,
        steep=(0.15, 0.25),
        gaps=(0.3, 0.3, 2.6),
        trees=0.25,
    ),
    Style(  # of brick
        storeys=(3, 4, 4, 5),
        walls=("8f3f2c", "a4513a", "7c3a2e", "94604a"),
        trims=("22302c", "d9d2c0", "2b3a4d"),
        roofs=("55504c", "6a625c"),
        brick=0.95,
        shop=0.35,
        steep=(0.25, 0.45),
    ),
    Style(  # a garden suburb
        storeys=(1, 1, 2),
        walls=("f0ece2", "e6eef0", "f2e4d4", "dfe8d8"),
        trims=("2f6a8a", "8a3b4a", "4c7a3e"),
        roofs=("3e6a8c", "7a3f3a", "467a5c"),
        brick=0.0,
        shop=0.1,
        steep=(0.8, 1.1),
        gaps=(0.9, 2.6, 2.6),
        trees=0.7,
    ),
)


@dataclass(frozen=True, eq=False)
class Streets:
    """The streets of a city: at each of its crossings one along x and one along y, half a block each way."""

    cells: Bools  # (C, R) which crossings there are, without gaps in a row or a column
    first: tuple[int, int]  # column and row of the first

    @property
    def middle(self) -> tuple[float, float]:
        """Metres: of the rectangle around all crossings."""
        x, y = ((first + (n - 1) / 2) * PITCH for first, n in zip(self.first, self.cells.shape, strict=True))
        return x, y

    @property
    def reach(self) -> float:
        """Metres from the middle in which everything stands but the hills."""
        return PITCH * (float(np.hypot(*self.cells.shape)) / 2 + 1)

    def at(self, column: int, row: int) -> bool:
        """Whether there is a crossing."""
        c, r = column - self.first[0], row - self.first[1]
        return 0 <= c < self.cells.shape[0] and 0 <= r < self.cells.shape[1] and bool(self.cells[c, r])

    def lines(self, axis: int) -> list[NDArray[np.float64]]:
        """(2, 2) where each street along an axis begins and ends, in order: as far as it is driven."""
        streets = []
        for number, row in enumerate(self.cells.T if axis == 0 else self.cells):
            there = np.flatnonzero(row)
            ends = PITCH * (np.array([there[0] - 0.5, there[-1] + 0.5]) + self.first[axis])
            across = np.full(2, PITCH * (number + self.first[1 - axis]))
            streets.append(np.stack([ends, across] if axis == 0 else [across, ends], axis=1))
        return streets

    def __call__(self, x: Floats, y: Floats) -> tuple[tuple[Floats, Floats], tuple[Bools, Bools]]:
        """Metres from the nearest street each way, and whether it is there: also a block beyond its end."""
        inner = np.pad(self.cells, 2)
        along_x, along_y = inner.copy(), inner.copy()
        along_x[1:-1] |= inner[:-2] | inner[2:]
        along_y[:, 1:-1] |= inner[:, :-2] | inner[:, 2:]
        nearest = [np.round(value / np.float32(PITCH)) for value in (x, y)]
        c, r = (
            np.clip(value - first + 2, 0, n - 1).astype(np.int32)
            for value, first, n in zip(nearest, self.first, inner.shape, strict=True)
        )
        from_x, from_y = (v - np.float32(PITCH) * near for v, near in zip((x, y), nearest, strict=True))
        return (from_x, from_y), (along_x[c, r], along_y[c, r])


@dataclass(frozen=True)
class _Banked:
    """The ground of a city; where it is steep, a wall."""

    ground: Grid

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        color = self.ground(points, normals)
        steep = np.abs(normals[2]) < 0.5
        color[:, steep] = _STONE(points[:, steep], normals[:, steep])
        return color


@dataclass(frozen=True)
class _Water:
    """Ripples of two blues, along x."""

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        x, y, _ = np.clip(points, -1e5, 1e5)
        ripples = 0.6 * fractal(x, 3 * y, 9.0) + 0.4 * fractal(y, x, 2.3)
        return mix(rgb("27485a"), rgb("6f97a0"), np.clip(2.2 * ripples - 0.6, 0, 1))


def plan(panoramas: int) -> Streets:
    """The streets that so many panoramas fill: a square of crossings, but for its last column."""
    count = int(np.ceil(panoramas / PER_CROSSING))
    rows = int(np.ceil(np.sqrt(count)))
    columns = int(np.ceil(count / rows))
    cells = (np.arange(columns * rows) < count).reshape(columns, rows)
    return Streets(cells, (-((columns - 1) // 2), -((rows - 1) // 2)))


def city(streets: Streets, seed: int) -> list[Shape]:
    """All solids. The same arguments give the same city."""
    shapes = _ground(streets)
    (left, below), (columns, rows) = streets.first, streets.cells.shape
    for column, row in product(range(left - 1, left + columns), range(below - 1, below + rows)):
        shapes += moved(_block(streets, column, row, seed), column * PITCH, row * PITCH)
    x, y = streets.middle
    reach = max(columns, rows) * PITCH / 2
    for hill in hills(np.random.default_rng([seed, 10]), reach, 14 + round(reach / 18)):
        off = float(hill.center[1]) + y - _MIDDLE  # from the river
        dry = hill.radius + _QUAY + 10
        shapes += moved([hill], x, y + (np.copysign(dry, off) - off if abs(off) < dry else 0.0))
    return shapes


def _ground(streets: Streets) -> list[Shape]:
    """The ground without end on both sides of the river, its quays and bridges."""
    paint = _Banked(Grid(Ground(ROAD, GARDEN, ()), Slabs(ROAD), streets, streaked=False))
    south, north, wide = _MIDDLE - _QUAY, _MIDDLE + _QUAY, GARDEN + 0.3
    shapes: list[Shape] = [
        _endless([((0, 0, 1), 0.0), ((0, 1, 0), south)], paint),
        _endless([((0, 0, 1), 0.0), ((0, -1, 0), -north)], paint),
        _endless([((0, 0, 1), _WATER)], _Water()),
    ]
    columns = range(streets.first[0] - 1, streets.first[0] + streets.cells.shape[0])
    for column in columns:
        x = column * PITCH
        for quay in (south - 0.2, north + 0.2):
            shapes.append(box((x + wide, quay - 0.2, 0), (x + PITCH - wide, quay + 0.2, 0.7), _STONE))
        if not (streets.at(column, 0) or streets.at(column, 1)):
            continue
        shapes.append(box((x - wide, south, -_BRIDGE), (x + wide, north, 0), paint))
        for edge in (x - wide + 0.15, x + wide - 0.15):
            shapes.append(box((edge - 0.15, south - 0.4, 0), (edge + 0.15, north + 0.4, 1.0), _STONE))
        shapes += [_pier(x, y, wide - 0.2) for y in (_MIDDLE - 4.5, _MIDDLE + 4.5)]
    return shapes


def _endless(planes: list[tuple[tuple[int, int, int], float]], paint: Paint) -> Convex:
    """All points below each of the planes: a direction, and how far along it."""
    normals, offsets = (np.array(part, np.float32) for part in zip(*planes, strict=True))
    return Convex(normals, offsets, np.zeros(3, np.float32), np.inf, paint)


def _pier(x: float, y: float, half: float) -> Shape:
    """A pier of a bridge along y, wider to its top, like the springing of an arch."""
    planes: list[Plane] = [((0, s, -0.55), (x, y + 0.7 * s, _WATER)) for s in (-1.0, 1.0)]
    planes += [((s, 0, 0), (x + s * half, y, 0)) for s in (-1.0, 1.0)]
    planes += [((0, 0, 1), (x, y, -_BRIDGE)), ((0, 0, -1), (x, y, _WATER - 1))]
    return convex(planes, _STONE)


def _block(streets: Streets, column: int, row: int, seed: int) -> list[Shape]:
    """A block, and the streets on its south and west; without what would face a street that is not there."""
    random = np.random.default_rng([seed, 9, column + 2**20, row + 2**20])
    corners = {(c, r): streets.at(column + c, row + r) for c, r in product((0, 1), (0, 1))}
    south, north = (corners[0, r] or corners[1, r] for r in (0, 1))
    west, east = (corners[c, 0] or corners[c, 1] for c in (0, 1))
    along_x, along_y = street_sides(random)
    shapes = [*(along_x if south else []), *(along_y if west else [])]
    kind = (column + 3 * row + 6) % 8
    if row == 0:
        return shapes + _river(random)
    if kind == 1:
        if (column + row) % 3 == 0:
            return shapes + _paved(random) + moved(church(), PITCH / 2 - 57.8, PITCH / 2)
        return shapes + (_monument if (column + row) % 3 == 1 else _park)(random)
    style = _STYLES[(seed + column // _DISTRICT + 2 * (row // _DISTRICT)) % len(_STYLES)]
    rows = zip(houses(random, style), _avenues(random, style), (south, north, west, east), strict=True)
    for facing, trees, there in rows:
        shapes += [*facing, *trees] if there else []
    return shapes + (_tower(random, style) if kind in (3, 6) else courtyard(random))


def _avenues(random: np.random.Generator, style: Style) -> list[list[Shape]]:
    """Trees along the streets of a block, on its south, north, west and east."""
    sides: list[list[Shape]] = []
    for quarters, x, y in ((0, 0.0, 0.0), (2, PITCH, PITCH), (3, 0.0, PITCH), (1, PITCH, 0.0)):
        trees: list[Shape] = []
        for along in np.arange(11.5, PITCH - 10, 8.2).tolist():
            if random.random() < style.trees:
                trees += tree(random, along, 6.4, float(random.uniform(4.2, 6.2)), BALLS)
        sides.append(moved(trees, x, y, quarters))
    return sides


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


def _river(random: np.random.Generator) -> list[Shape]:
    """Trees and benches along both banks, and boats."""
    shapes: list[Shape] = []
    for y, along in product((8.5, PITCH - 8.5), np.linspace(10, PITCH - 10, 5).tolist()):
        x = along + float(random.uniform(-1.5, 1.5))
        shapes += tree(random, x, y, float(random.uniform(5.5, 8.5)), BALLS)
    for y in (_MIDDLE - 9.5, _MIDDLE + 7.0):
        if random.random() < 0.6:
            hull = rgb(str(random.choice(_CLOTHS)))
            shapes += _boat(float(random.uniform(14, PITCH - 14)), y + float(random.uniform(0, 2)), hull)
    for y, x in product((12.2, PITCH - 12.2), (18.0, 38.0)):
        shapes += _bench(x, y)
    return shapes


def _boat(x: float, y: float, color: Color) -> list[Shape]:
    """A boat that lies along x."""
    sides: list[Plane] = [((0.0, s, -0.35), (x, y + 1.3 * s, _WATER + 0.6)) for s in (-1.0, 1.0)]
    bow: list[Plane] = [((0.55, s, -0.3), (x + 2.6, y + 1.3 * s, _WATER + 0.6)) for s in (-1.0, 1.0)]
    ends: list[Plane] = [((0, 0, 1), (x, y, _WATER + 0.6)), ((0, 0, -1), (x, y, _WATER - 0.5))]
    hull = convex([*sides, *bow, *ends, ((-1, 0, -0.2), (x - 4, y, _WATER + 0.6))], Plain(color, 0.3))
    cabin = Plain(rgb("e6e0d2"), 0.3)
    return [hull, box((x - 2.6, y - 0.8, _WATER + 0.6), (x + 0.6, y + 0.8, _WATER + 1.9), cabin)]


def _bench(x: float, y: float) -> list[Shape]:
    wood = Plain(rgb("7a5a3a"), 0.6, 1.2)
    return [
        box((x - 0.9, y - 0.25, 0.36), (x + 0.9, y + 0.25, 0.45), wood),
        *(box((x + dx - 0.06, y - 0.2, 0), (x + dx + 0.06, y + 0.2, 0.36), _STONE) for dx in (-0.7, 0.7)),
    ]


def _paved(random: np.random.Generator) -> list[Shape]:
    """A square with trees along two of its sides, and benches."""
    edge = 8.0
    shapes: list[Shape] = [box((edge, edge, 0), (PITCH - edge, PITCH - edge, 0.12), Slabs(ROAD))]
    for along in np.linspace(edge + 3, PITCH - edge - 3, 5).tolist():
        for x, y in ((along, edge + 3), (along, PITCH - edge - 3)):
            shapes += tree(random, x, y, float(random.uniform(4.5, 6.5)), BALLS)
    for x, y in product((17.5, 38.5), (edge + 3, PITCH - edge - 3)):
        shapes += _bench(x, y)
    return shapes


def _monument(random: np.random.Generator) -> list[Shape]:
    """A column on steps, and the stalls of a market."""
    shapes, middle = _paved(random), PITCH / 2
    for half, low, high in ((2.2, 0.12, 0.5), (1.6, 0.5, 0.9), (1.0, 0.9, 3.2)):
        shapes.append(box((middle - half, middle - half, low), (middle + half, middle + half, high), _STONE))
    shapes.append(ellipsoid((middle, middle, 7.2), (0.75, 0.75, 4.6), _STONE))
    shapes.append(ellipsoid((middle, middle, 12.2), (0.9, 0.9, 0.9), Plain(rgb("c9a14a"), 0.3)))
    for x, y in product((16.0, 22.0, 34.0, 40.0), (18.0, 38.0)):
        if random.random() < 0.75:
            shapes += _stall(x, y, rgb(str(random.choice(_CLOTHS))))
    return shapes


def _stall(x: float, y: float, color: Color) -> list[Shape]:
    """A market stall: a table under a cloth on posts."""
    wood = Plain(rgb("8a6a45"), 0.6, 1.5)
    roof: list[Plane] = [((0.0, s * 0.5, 1.0), (x, y, 2.75)) for s in (-1.0, 1.0)]
    roof += [((s, 0, 0), (x + s * 1.7, y, 2)) for s in (-1.0, 1.0)]
    roof += [((0, s, 0), (x, y + s * 1.3, 2)) for s in (-1.0, 1.0)]
    posts = product((x - 1.5, x + 1.5), (y - 1.1, y + 1.1))
    return [
        convex([*roof, ((0, 0, -1), (x, y, 2.05))], Stripes(color)),
        box((x - 1.5, y - 0.7, 0.12), (x + 1.5, y + 0.7, 0.9), wood),
        *(box((a - 0.05, b - 0.05, 0.12), (a + 0.05, b + 0.05, 2.15), wood) for a, b in posts),
    ]


def _park(random: np.random.Generator) -> list[Shape]:
    """Trees around a pond, paths and benches."""
    middle, gravel = PITCH / 2, Plain(rgb("c2b08c"), 0.5, 3.0)
    shapes: list[Shape] = [ellipsoid((middle, middle, 0), (7.5, 5.5, 0.05), _Water())]
    for low, high in pairwise((8.0, 20.0, 36.0, 48.0)):
        if (low, high) != (20.0, 36.0):
            shapes.append(box((low, middle - 1, 0), (high, middle + 1, 0.04), gravel))
            shapes.append(box((middle - 1, low, 0), (middle + 1, high, 0.04), gravel))
    for _ in range(16):
        angle, away = float(random.uniform(0, 2 * np.pi)), float(random.uniform(11.5, 18))
        x, y = middle + away * np.cos(angle), middle + away * np.sin(angle)
        if min(abs(x - middle), abs(y - middle)) > 2:
            shapes += tree(random, x, y, float(random.uniform(6, 10)), BALLS)
    for x, y in product((middle - 4, middle + 4), (middle - 7.5, middle + 7.5)):
        shapes += _bench(x, y)
    return shapes


def drive(streets: Streets, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotations (count, 3, 3) and camera centres (count, 3) in metres, `STEP` apart.

    Along all streets, to and fro: first those along x from north to south, then those along y from east to
    west, of which the last may be driven in part. Like a car, that turns out of sight beyond its end.
    """
    random = np.random.default_rng([seed, 11])
    lines = streets.lines(0)[::-1] + streets.lines(1)[::-1]
    if streets.cells.shape[1] % 2 == 0:
        lines[0] = lines[0][::-1]  # so that those along x end in the east
    for before, line in pairwise(lines):  # each from its end that is nearer to where the last one ended
        if np.linalg.norm(line[0] - before[1]) > np.linalg.norm(line[1] - before[1]):
            line[:] = line[::-1].copy()
    starts = np.array([line[0] for line in lines])
    ways = np.array([line[1] - line[0] for line in lines])
    lengths = np.linalg.norm(ways, axis=1)
    ends = np.cumsum(lengths)
    way = np.minimum((np.arange(count) + random.uniform(0.4, 0.6, count)) * STEP, ends[-1] - 0.1)
    street = np.searchsorted(ends, way, side="right")
    ahead = (ways / lengths[:, None])[street]
    aside = 0.5 * np.sin(way / 6.0) + random.uniform(-0.2, 0.2, count)
    along = way - ends[street] + lengths[street]
    place = starts[street] + along[:, None] * ahead + aside[:, None] * ahead[:, ::-1] * [-1, 1]
    z = 2.0 + random.uniform(-0.04, 0.04, count)
    yaw = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])) + random.uniform(-8, 8, count)
    tilt, roll = random.uniform(-1.5, 1.5, (2, count))
    turned = Rotation.from_euler("ZYX", np.stack([yaw, tilt, roll], axis=1), degrees=True)  # in the world
    rotations = np.ascontiguousarray(AHEAD @ turned.inv().as_matrix())
    return rotations, np.concatenate([place, z[:, None]], axis=1)
