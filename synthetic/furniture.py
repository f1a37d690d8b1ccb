"""Small things: trees, hedges, cars, lamps."""

import numpy as np

from panolog.synthetic.paint import Cabin, Color, Foliage, Plain, rgb
from panolog.synthetic.shapes import Plane, Shape, box, convex, ellipsoid

LEAVES = (("2c4a1e", "7fa045"), ("34551f", "9cb04c"), ("5a4316", "d0962f"), ("27482c", "6d9a55"))
HEDGE = Foliage(rgb("26421d"), rgb("6f9340"), 2.5)
BALLS = 24  # of leaves in a crown


def tree(random: np.random.Generator, x: float, y: float, size: float, balls: int = BALLS) -> list[Shape]:
    """A trunk and a crown of overlapping balls of leaves; `size` is its height in metres."""
    dark, light = LEAVES[int(random.integers(len(LEAVES)))]
    leaves = Foliage(rgb(dark), rgb(light))
    bark = Plain(rgb("5d4a38"), 0.9, 1.5)
    shapes: list[Shape] = [ellipsoid((x, y, 0.2 * size), (0.035 * size, 0.035 * size, 0.36 * size), bark)]
    for turn in range(balls):
        angle, height = turn * 2.399963, (turn + 0.5) / balls  # the golden angle spreads them evenly
        spread = 0.24 * size * float(np.sin(np.pi * (0.15 + 0.8 * height)) * random.uniform(0.6, 1.1))
        radius = size * float(random.uniform(0.075, 0.13)) * (BALLS / balls) ** (1 / 3)
        place = (x + spread * np.cos(angle), y + spread * np.sin(angle), size * (0.46 + 0.44 * height))
        shapes.append(ellipsoid(place, (radius, radius, 0.85 * radius), leaves))
    return shapes


def hedge(left: float, right: float, y: float) -> Shape:
    """A trimmed hedge along x."""
    return box((left, y - 0.3, 0), (right, y + 0.3, 0.85), HEDGE)


def lamp(x: float, y: float) -> list[Shape]:
    """A street lamp: a post, a globe and a roof over it."""
    metal, glass = Plain(rgb("39413f"), 0.3), Plain(rgb("fff3cf"), 0.1)
    return [
        box((x - 0.07, y - 0.07, 0), (x + 0.07, y + 0.07, 4.2), metal),
        ellipsoid((x, y, 4.35), (0.24, 0.24, 0.3), glass),
        box((x - 0.3, y - 0.3, 4.6), (x + 0.3, y + 0.3, 4.68), metal),
    ]


def car(x: float, y: float, color: Color) -> list[Shape]:
    """A parked car that faces along x."""
    body: list[Plane] = [
        *(((sign, 0, 0), (x + 2.05 * sign, y, 0.6)) for sign in (-1, 1)),
        *(((0, sign, 0), (x, y + 0.85 * sign, 0.6)) for sign in (-1, 1)),
        ((0, 0, 1), (x, y, 0.92)),
        ((0, 0, -1), (x, y, 0.26)),
        ((1, 0, 2.2), (x + 1.6, y, 0.86)),
        ((-1, 0, 2.5), (x - 1.7, y, 0.88)),
    ]
    cabin: list[Plane] = [
        ((0, 0, 1), (x, y, 1.46)),
        ((0, 0, -1), (x, y, 0.8)),
        ((0.75, 0, 1), (x + 0.65, y, 1.4)),
        ((-1.6, 0, 1), (x - 1.6, y, 1.3)),
        *(((0, sign, 0.25), (x, y + 0.78 * sign, 0.9)) for sign in (-1, 1)),
    ]
    tyre = Plain(rgb("2a2a2c"), 0.2)
    wheels = [(x + dx, y + dy, 0.33) for dx in (-1.3, 1.3) for dy in (-0.78, 0.78)]
    return [
        convex(body, Plain(color, 0.15)),
        convex(cabin, Cabin(color, 0.95, 1.36, (x - 0.2, x - 1.3, x + 0.75))),
        *(ellipsoid(wheel, (0.33, 0.12, 0.33), tyre) for wheel in wheels),
    ]
