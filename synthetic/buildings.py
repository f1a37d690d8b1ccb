"""Houses with gabled roofs, and the church at the end of the street."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.facade import STOREY, Facade
from panolog.synthetic.paint import Plain, Stripes, Tiles, rgb
from panolog.synthetic.shapes import Convex, Paint, Plane, Shape, box, convex

Vector = NDArray[np.float64]  # (3,)
OVERHANG, THICK = 0.45, 0.16  # metres, of roofs


@dataclass(frozen=True)
class Style:
    """How the houses of a neighbourhood look: those of a town, unless given otherwise."""

    storeys: tuple[int, ...] = (1, 2, 2, 3)  # one of them, and of each of the colours
    walls: tuple[str, ...] = ("d9b48a", "c96f4f", "e6dcc4", "b9c4b0", "d8a35c", "a8b8c8", "c98b7a", "e0c690")
    trims: tuple[str, ...] = ("3e6b5a", "2f5573", "7b3b33", "44604a", "5a4a6d", "8a5a34")
    roofs: tuple[str, ...] = ("a8492f", "8c3f2e", "5b5f6b", "b4613c", "7a4a38")
    brick: float = 0.35  # share of the houses, also of those with two storeys with a shop
    shop: float = 0.3
    steep: tuple[float, float] = (0.65, 0.95)  # rise of a roof over its run, least and most
    gaps: tuple[float, ...] = (0.3, 0.9, 2.6)  # one of them between two houses, metres
    trees: float = 0.0  # share of the places for trees along the streets


TOWN = Style()


@dataclass(frozen=True)
class Gable:
    """The outline of a house: walls up to `eave`, two slopes up to `ridge`, which runs along x or along y."""

    center: tuple[float, float]
    half: tuple[float, float]
    eave: float
    ridge: float
    along_x: bool

    @property
    def across(self) -> int:
        """The axis, 0 or 1, across the ridge."""
        return 1 if self.along_x else 0

    def body(self, paint: Paint) -> Convex:
        """The walls and what is between them."""
        planes = self._ends()
        for sign in (-1.0, 1.0):
            out, slope, edge = self._side(sign)
            planes += [(out, edge), (slope, edge)]
        planes.append((np.array([0, 0, -1]), np.array([*self.center, 0])))
        return convex(planes, paint)

    def roof(self, paint: Paint) -> list[Convex]:
        """The two slopes, slabs that hang over the walls."""
        wider = replace(self, half=(self.half[0] + 0.3, self.half[1] + 0.3))
        slabs = []
        for sign in (-1.0, 1.0):
            out, slope, edge = self._side(sign)
            top = edge + THICK * slope / np.linalg.norm(slope)
            sides = [(slope, top), (-slope, edge), (out, edge + OVERHANG * out)]
            slabs.append(
                convex([*wider._ends(), *sides, (-out, np.array([*self.center, self.ridge]))], paint)
            )
        return slabs

    def _ends(self) -> list[Plane]:
        """The two gables: planes across the ridge."""
        axis = 1 - self.across
        direction, middle = np.eye(3)[axis], np.array([*self.center, 0])
        return [(sign * direction, middle + sign * self.half[axis] * direction) for sign in (-1.0, 1.0)]

    def _side(self, sign: float) -> tuple[Vector, Vector, Vector]:
        """A side of the ridge: the directions out of its wall and its slope, and a point on its eave."""
        out, span = sign * np.eye(3)[self.across], self.half[self.across]
        slope = (self.ridge - self.eave) * out + np.array([0, 0, span])
        return out, slope, np.array([*self.center, self.eave]) + span * out


def house(
    random: np.random.Generator, x: float, side: float, half: float, style: Style = TOWN
) -> list[Shape]:
    """Walls, roof, chimney, maybe an awning: a house around x on the side +1 or -1, 2 * half wide."""
    storeys = int(random.choice(style.storeys))
    depth, setback = float(random.uniform(3.6, 4.6)), float(random.uniform(7.6, 9.0))
    eave = storeys * STOREY + float(random.uniform(0.1, 0.5))
    along_x = bool(random.random() < 0.6)
    ridge = eave + (depth if along_x else half) * float(random.uniform(*style.steep))
    gable = Gable((x, side * (setback + depth)), (half, depth), eave, ridge, along_x)
    trim = rgb(str(random.choice(style.trims)))
    walls = Facade(
        gable.center,
        gable.half,
        storeys,
        wall=rgb(str(random.choice(style.walls))),
        trim=trim,
        brick=bool(random.random() < style.brick),
        shop=bool(random.random() < style.shop) and storeys > 1,
        salt=int(random.integers(1000)),
    )
    roof = gable.roof(Tiles(rgb(str(random.choice(style.roofs))), along_x))
    shapes: list[Shape] = [gable.body(walls), *roof, _chimney(gable, float(random.uniform(-0.6, 0.6)))]
    if walls.shop:
        shapes.append(_awning(x, side * setback, half - 0.5, Stripes(trim)))
    return shapes


def _chimney(gable: Gable, shift: float) -> Shape:
    """A chimney next to the ridge, at `shift` in (-1, 1) along it."""
    x, y = gable.center
    x, y = (x + gable.half[0] * shift, y + 0.9) if gable.along_x else (x + 0.9, y + gable.half[1] * shift)
    lower, upper = (x - 0.4, y - 0.35, gable.ridge - 2), (x + 0.4, y + 0.35, gable.ridge + 0.9)
    return box(lower, upper, Plain(rgb("9a5b45"), 0.8, 2.0))


def _awning(x: float, wall: float, half: float, paint: Paint) -> Shape:
    """A sloping cloth over the shop window in the wall y = `wall`."""
    side = float(np.sign(wall))
    outer, slope = wall - 1.3 * side, np.array([0.0, -0.5 * side, 1.3])
    planes: list[Plane] = [
        ((-1, 0, 0), (x - half, wall, 2.8)),
        ((1, 0, 0), (x + half, wall, 2.8)),
        ((0, side, 0), (x, wall, 2.8)),
        ((0, -side, 0), (x, outer, 2.8)),
        (slope, (x, wall, 3.05)),
        (-slope, (x, wall, 2.95)),
    ]
    return convex(planes, paint)


def church() -> list[Shape]:
    """The landmark at the eastern end of the street: a tower with a pointed roof before a nave."""
    stone, wood = rgb("d6c8ad"), rgb("5a4636")
    tiles = Tiles(rgb("5f6b73"), True)
    nave = Gable((60.0, 0.0), (9.0, 5.5), eave=7.0, ridge=11.5, along_x=True)
    tower = Facade((49.0, 0.0), (2.4, 2.4), 5, stone, wood, brick=True, salt=78)
    spire: list[Plane] = [
        ((6.5 * a, 6.5 * b, 2.7), (49 + 2.7 * a, 2.7 * b, 15.5))
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    return [
        box((46.6, -2.4, 0), (51.4, 2.4, 15.5), tower),
        convex([*spire, ((0, 0, -1), (49.0, 0.0, 15.5))], tiles),
        nave.body(Facade(nave.center, nave.half, 2, stone, wood, brick=True, salt=77)),
        *nave.roof(tiles),
    ]
