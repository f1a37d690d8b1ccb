"""A district: blocks of houses around courtyards in a grid of streets, and a flight over it.

World: metres, z up. Streets are every `PITCH` metres in both directions, the middle is that of the district.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.synthetic.buildings import TOWN, Style, house
from panolog.synthetic.furniture import car, lamp, tree
from panolog.synthetic.layout import AHEAD, GARDEN, ROAD
from panolog.synthetic.paint import Foliage, Grid, Ground, Rectangle, Slabs, rgb
from panolog.synthetic.shapes import Convex, Shape, ellipsoid, moved

PITCH = 56.0  # metres between streets
_CORNER, _DEEP = 9.0, 19.0  # metres from a street's middle at which houses begin, and end
_COLORS = ("9c2f2a", "d9d4c7", "2f5d8a", "c9962f", "4a4d52", "6d8f62")
BALLS = 8  # of leaves in a crown: it is seen from far
_ORBIT = 1 / 4  # of the panoramas of a flight
_LOW, _HIGH = 25.0, 60.0  # metres above the ground of a flight


def district(columns: int, rows: int, seed: int) -> list[Shape]:
    """All solids of `columns` x `rows` blocks. The same arguments give the same district."""
    half = (columns * PITCH / 2, rows * PITCH / 2)
    up, level, origin = np.array([[0, 0, 1]], np.float32), np.zeros(1, np.float32), np.zeros(3, np.float32)
    grid = Grid(Ground(ROAD, GARDEN, ()), Slabs(ROAD), Rectangle(PITCH, half, GARDEN))
    shapes: list[Shape] = [Convex(up, level, origin, np.inf, grid)]
    for column in range(columns):
        for row in range(rows):
            random = np.random.default_rng([seed, 6, column, row])
            shapes += moved(block(random), column * PITCH - half[0], row * PITCH - half[1])
    return shapes + hills(np.random.default_rng([seed, 7]), max(half))


def block(random: np.random.Generator) -> list[Shape]:
    """One block and the streets on its south and west, which are y = 0 and x = 0."""
    parts = [*houses(random), courtyard(random), *street_sides(random)]
    return [shape for part in parts for shape in part]


def houses(random: np.random.Generator, style: Style = TOWN) -> list[list[Shape]]:
    """The houses around a block: those on its south, north, west and east."""
    return [
        moved(_row(random, first, PITCH - first, style), x, y, quarters)
        for quarters, x, y, first in (
            (0, 0.0, 0.0, _CORNER),  # along x, from corner to corner
            (2, PITCH, PITCH, _CORNER),
            (3, 0.0, PITCH, _DEEP),  # along y, between those
            (1, PITCH, 0.0, _DEEP),
        )
    ]


def courtyard(random: np.random.Generator) -> list[Shape]:
    """A few trees in the middle of a block."""
    shapes: list[Shape] = []
    for _ in range(int(random.integers(2, 6))):
        x, y = random.uniform(_DEEP + 3, PITCH - _DEEP - 3, 2).tolist()
        shapes += tree(random, x, y, float(random.uniform(5, 10)), BALLS)
    return shapes


def street_sides(random: np.random.Generator) -> list[list[Shape]]:
    """Cars and lamps of the street y = 0, and of the street x = 0."""
    sides: list[list[Shape]] = []
    for quarters in (0, 1):
        shapes: list[Shape] = []
        for lane in (2.3, -2.3):
            if random.random() < 0.7:
                paint = rgb(str(random.choice(_COLORS)))
                shapes += car(float(random.uniform(8, PITCH - 8)), lane, paint)
        sides.append(moved(shapes + lamp(PITCH / 2, 3.8), 0, 0, quarters))
    return sides


def _row(random: np.random.Generator, first: float, last: float, style: Style) -> list[Shape]:
    """Houses along the street y = 0 on its side +1, between two x."""
    shapes: list[Shape] = []
    count = max(1, round((last - first) / float(random.uniform(8.5, 10.5))))
    width = (last - first) / count
    for number in range(count):
        half = (width - float(random.choice(style.gaps))) / 2
        shapes += house(random, first + (number + 0.5) * width, 1.0, half, style)
    return shapes


def hills(random: np.random.Generator, reach: float, count: int = 17) -> list[Shape]:
    """Wooded hills around a district that ends at `reach`."""
    forest = Foliage(rgb("3d5a3a"), rgb("8fa866"), 60.0)
    shapes: list[Shape] = []
    for turn in range(count):
        angle = 2 * np.pi * (turn + float(random.uniform(0, 0.7))) / count
        away, wide = 1.6 * reach + float(random.uniform(80, 160)), float(random.uniform(60, 110))
        center = (away * np.cos(angle), away * np.sin(angle), -6)
        shapes.append(ellipsoid(center, (wide, wide, float(random.uniform(20, 45))), forest))
    return shapes


def flight_path(
    columns: int, rows: int, count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotations (count, 3, 3) and camera centres (count, 3) in metres, over a district.

    Lanes to and fro along x, at a height that changes slowly, then an orbit around the middle. The camera
    looks along its way, and the wind turns and tilts it a little.
    """
    random = np.random.default_rng([seed, 8])
    orbit = round(count * _ORBIT)
    half = np.array([columns, rows]) * PITCH / 2
    centers = np.concatenate([_lanes(half, count - orbit), _orbit(half, orbit)])
    centers += random.normal(0, [1.0, 1.0, 0.5], (count, 3))
    way = np.gradient(centers, axis=0)
    yaw = np.degrees(np.arctan2(way[:, 1], way[:, 0])) + random.uniform(-8, 8, count)
    tilt, roll = random.uniform(-4, 4, (2, count))
    turned = Rotation.from_euler("ZYX", np.stack([yaw, tilt, roll], axis=1), degrees=True)
    return np.ascontiguousarray(AHEAD @ turned.inv().as_matrix()), centers


def _lanes(half: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(count, 3) centres along lanes as far apart as the panoramas on them."""
    lanes = max(1, round(np.sqrt(count * half[1] / half[0])))
    share = (np.arange(count) + 0.5) / count * lanes
    lane, at = np.divmod(share, 1.0)
    x = np.where(lane % 2 == 0, at, 1 - at) * 2 * half[0] - half[0]
    y = (lane + 0.5) / lanes * 2 * half[1] - half[1]
    swing = np.sin(np.linspace(0, 5 * np.pi, count))
    return np.stack([x, y, (_LOW + _HIGH) / 2 + (_HIGH - _LOW) / 2 * swing], axis=1)


def _orbit(half: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(count, 3) centres on an ellipse around the middle."""
    angle = 2 * np.pi * np.arange(count) / max(count, 1)
    x, y = 0.8 * half[0] * np.cos(angle), 0.8 * half[1] * np.sin(angle)
    return np.stack([x, y, np.full(count, (_LOW + _HIGH) / 2)], axis=1)
