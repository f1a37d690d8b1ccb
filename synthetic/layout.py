"""Where everything stands: a street along x, houses on both sides, a church, trees, cars, hills, the camera.

World: metres, z up; the street is |y| < 3.3, pavements reach to 5, houses begin at about 8.
"""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.synthetic.buildings import church, house
from panolog.synthetic.furniture import car, hedge, lamp, tree
from panolog.synthetic.noise import Floats
from panolog.synthetic.paint import Foliage, Ground, Slabs, rgb
from panolog.synthetic.shapes import Convex, Shape, box, ellipsoid

ROAD, GARDEN = 3.3, 5.0
STEP, LONGEST = 1.5, 56.0  # metres between panoramas, and of the whole path
# Camera x right, y down, z forward, with forward along the world's x and down against its z.
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CARS = ((-17.5, 2.3, "9c2f2a"), (-3.0, -2.3, "d9d4c7"), (6.5, 2.3, "2f5d8a"), (21.0, -2.3, "c9962f"))
Lots = tuple[tuple[float, float], ...]  # of each house the x of its middle, where its door is, and its side


def town(seed: int) -> list[Shape]:
    """All solids. The same seed gives the same town."""
    random = np.random.default_rng([seed, 1])
    lots, houses = _houses(random)
    shapes: list[Shape] = [*_street(lots), *houses, *church(), *_gardens(random, lots)]
    for x, y, color in CARS:
        shapes += car(x + float(random.uniform(-1, 1)), y, rgb(color))
    for index, x in enumerate(np.arange(-30.0, 36.0, 12.0).tolist()):
        shapes += lamp(x, 3.8 if index % 2 else -3.8)
    return [*shapes, *_hills(random)]


def sun() -> Floats:
    """(3,) unit vector to the sun: a warm afternoon, across the street."""
    direction = np.array([-0.5, -0.42, 0.52])
    return np.asarray(direction / np.linalg.norm(direction), np.float32)


def camera_path(count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotations (count, 3, 3) and camera centres (count, 3) in metres.

    At head height along the street; the path meanders, steps differ, and the camera turns and tilts a little.
    """
    random = np.random.default_rng([seed, 2])
    length = min(STEP * (count - 1), LONGEST)
    x = np.linspace(-length / 2, length / 2, count) + random.uniform(-0.3, 0.3, count) * length / count
    y = 0.6 * np.sin(x / 6.0) + random.uniform(-0.25, 0.25, count)
    z = 1.65 + random.uniform(-0.04, 0.04, count)
    yaw = 10 * np.cos(x / 6.0) + random.uniform(-6, 6, count)
    tilt, roll = random.uniform(-1.5, 1.5, (2, count))
    turned = Rotation.from_euler("ZYX", np.stack([yaw, tilt, roll], axis=1), degrees=True)  # in the world
    rotations = AHEAD @ turned.inv().as_matrix()
    return np.ascontiguousarray(rotations), np.stack([x, y, z], axis=1)


def _houses(random: np.random.Generator) -> tuple[Lots, list[Shape]]:
    """Two rows, wall to wall or with gaps."""
    lots: list[tuple[float, float]] = []
    shapes: list[Shape] = []
    for side in (-1.0, 1.0):
        x = -39.0
        while x < 36.0:
            half = float(random.uniform(3.6, 4.8))
            lots.append((x + half, side))
            shapes += house(random, x + half, side, half)
            x += 2 * half + float(random.choice([0.9, 2.6, 3.6]))
    return tuple(lots), shapes


def _street(lots: Lots) -> list[Shape]:
    """The ground without end, and the pavements in pieces: a ray is only tried on what is near it."""
    up, level, origin = np.array([[0, 0, 1]], np.float32), np.zeros(1, np.float32), np.zeros(3, np.float32)
    slabs = Slabs(ROAD)
    return [
        Convex(up, level, origin, np.inf, Ground(ROAD, GARDEN, lots)),
        *(
            box((x, y, 0), (x + 8.0, y + GARDEN - ROAD, 0.13), slabs)
            for y in (-GARDEN, ROAD)
            for x in np.arange(-72.0, 72.0, 8.0).tolist()
        ),
    ]


def _gardens(random: np.random.Generator, lots: Lots) -> list[Shape]:
    """Between two doors a hedge and a tree; at the western end a grove."""
    shapes: list[Shape] = []
    for side in (-1.0, 1.0):
        for left, right in pairwise(x for x, at in lots if at == side):
            shapes.append(hedge(left + 1.2, right - 1.2, 5.55 * side))
            x = (left + right) / 2 + float(random.uniform(-0.6, 0.6))
            shapes += tree(random, x, side * float(random.uniform(6.3, 6.8)), float(random.uniform(4.6, 7.0)))
    for _ in range(7):
        x, y = float(random.uniform(-62, -46)), float(random.uniform(-11, 11))
        shapes += tree(random, x, y, float(random.uniform(7, 11)))
    return shapes


def _hills(random: np.random.Generator) -> list[Shape]:
    """Wooded hills around, so that the horizon is not a line."""
    forest = Foliage(rgb("3d5a3a"), rgb("8fa866"), 60.0)
    shapes: list[Shape] = []
    for turn in range(11):
        angle = 2 * np.pi * (turn + float(random.uniform(0, 0.7))) / 11
        away, tall = float(random.uniform(120, 170)), float(random.uniform(14, 32))
        wide = float(random.uniform(45, 75))
        shapes.append(ellipsoid((away * np.cos(angle), away * np.sin(angle), -4), (wide, wide, tall), forest))
    return shapes
