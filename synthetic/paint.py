"""Colours of surfaces: linear RGB albedo as a function of position, independent of the viewer."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.noise import Floats, cell, fractal

Bools = NDArray[np.bool_]
Color = tuple[float, float, float]  # linear RGB
_FAR = 2e5  # metres beyond which the ground is all haze


def rgb(code: str) -> Color:
    """Linear RGB of a display colour such as "c8b090"."""
    red, green, blue = (float((int(code[i : i + 2], 16) / 255) ** 2.2) for i in (0, 2, 4))
    return red, green, blue


def column(color: Color) -> Floats:
    """The colour as (3, 1), ready to broadcast over (3, N)."""
    return np.array(color, np.float32)[:, None]


def mix(under: Floats | Color, over: Floats | Color, weight: Floats | Bools) -> Floats:
    """(3, N): `over` laid on `under`, where `weight` (N,) is 1, or bool True, it covers."""
    below, top = (column(it) if isinstance(it, tuple) else it for it in (under, over))
    if weight.dtype == np.bool_:
        return np.where(weight, top, below)
    return below + weight * (top - below)


def speckle(color: Color, shade: Floats) -> Floats:
    """(3, N): the colour times a brightness (N,)."""
    return column(color) * shade


@dataclass(frozen=True)
class Plain:
    """One colour with fractal stains; `grain` is their contrast, `period` their size in metres."""

    color: Color
    grain: float = 0.5
    period: float = 6.0

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        stain = fractal(points[0] + 0.7 * points[2], points[1] + 0.6 * points[2], self.period)
        return speckle(self.color, 1 + self.grain * (stain - 0.5))


@dataclass(frozen=True)
class Foliage:
    """Leaves: two greens in clumps. Also hedges and hills."""

    dark: Color
    light: Color
    period: float = 4.0

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        x, y, z = points
        clumps = fractal(x + 0.6 * z, y - 0.5 * z, self.period)
        leaves = fractal(y + 0.9 * z, x - 0.7 * z, self.period / 3)
        weight = np.clip(2.6 * (0.5 * clumps + 0.5 * leaves) - 0.95 + 0.25 * normals[2], 0, 1)
        return mix(self.dark, self.light, weight)


@dataclass(frozen=True)
class Ground:
    """A road with markings along x; beyond the pavements grass, with paths to doors (x, side +1 or -1)."""

    road: float  # half width
    garden: float  # |y| where the grass begins
    doors: tuple[tuple[float, float], ...]

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        street = np.abs(points[1]) < self.garden
        color = np.empty_like(points)
        color[:, street] = self.asphalt(*points[:2, street])
        color[:, ~street] = self._gardens(*points[:2, ~street])
        return color

    def _gardens(self, x: Floats, y: Floats) -> Floats:
        path = np.zeros(len(x), np.bool_)
        for door, side in self.doors:
            path |= (np.abs(x - door) < 0.65) & (y * side > 0) & (y * side < 11)
        return mix(self.grass(x, y), speckle(rgb("b9a88c"), 0.75 + 0.5 * cell(x / 0.65, y / 0.5)), path)

    def grass(self, x: Floats, y: Floats) -> Floats:
        patches, blades = fractal(x, y, 23.0), fractal(y, x, 3.1)
        grass = mix(rgb("47622c"), rgb("94a352"), np.clip(2 * patches - 0.5, 0, 1))
        flowers = (cell(x / 0.22, y / 0.22) > 0.975) & (patches > 0.55)
        return mix(grass * (0.65 + 0.7 * blades), rgb("ead9a0"), flowers)

    def asphalt(self, x: Floats, y: Floats, bare: Bools | None = None) -> Floats:
        """The colours of a road along x; without markings where `bare` (N,)."""
        wear = fractal(x, y, 9.0) + 0.6 * fractal(y, x, 1.7)
        road = speckle(rgb("6b6662"), 0.55 + 0.5 * wear)
        patch = (cell(x / 7.0, y / 3.2, 5) > 0.8) & (np.abs(x % 7.0 - 3.5) < 2.4)
        road = mix(road, road * 0.62, patch)
        white = (np.abs(y) < 0.09) & (x % 3.0 < 1.6)
        white |= np.abs(np.abs(y) - self.road + 0.25) < 0.06
        crossing = np.abs(np.abs(x + 1.0) - 14.0) < 1.3
        white = np.where(crossing, (y + 0.25) % 1.0 < 0.5, white) & (np.abs(y) < self.road)
        white = white if bare is None else white & ~bare
        road = mix(road, rgb("e8e4d8"), white * (0.55 + 0.4 * np.clip(wear, 0, 1)))
        manhole = ((x - 4) % 13.0 - 6.5) ** 2 + (y - 0.9) ** 2
        return mix(road, rgb("3c3a38"), manhole < 0.13)


@dataclass(frozen=True)
class Rectangle:
    """A network of streets: along both axes every `pitch` metres, the outermost at x, y = ± half."""

    pitch: float
    half: tuple[float, float]  # metres
    edge: float  # metres that streets reach beyond

    def __call__(self, x: Floats, y: Floats) -> tuple[tuple[Floats, Floats], tuple[Bools, Bools]]:
        """The streets nearest to each place, as `Network` describes them."""
        from_x, from_y = (
            (value + half + 0.5 * self.pitch) % self.pitch - 0.5 * self.pitch
            for value, half in zip((x, y), self.half, strict=True)
        )
        inside = (np.abs(x) < self.half[0] + self.edge) & (np.abs(y) < self.half[1] + self.edge)
        return (from_x, from_y), (inside, inside)


# Of x, y (N,): how far they are from the middle of the nearest street along y and of that along x, in metres;
# and whether there is, as far along, a street along x and one along y.
Network = Callable[[Floats, Floats], tuple[tuple[Floats, Floats], tuple[Bools, Bools]]]


@dataclass(frozen=True)
class Grid:
    """The ground of a district: a network of streets with pavements; grass between them and beyond."""

    street: Ground
    slabs: "Slabs"
    network: Network
    streaked: bool = True  # crossings; the district keeps them, so that its bytes stay

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        x, y = np.clip(points[:2], -_FAR, _FAR)
        (from_x, from_y), (along_x, along_y) = self.network(x, y)
        color = self.street.grass(x, y)
        for along, away, here, other, across in (
            (x, from_y, along_x, from_x, along_y),
            (y, from_x, along_y, from_y, along_x),
        ):
            crossing = across & (np.abs(other) < self.street.garden)
            paved = here & (np.abs(away) < self.street.garden)
            side = paved & ~crossing & (np.abs(away) >= self.street.road)
            road = paved & ~side
            color[:, side] = self.slabs(np.stack([along, away, along])[:, side], normals[:, side])
            aside = np.where(crossing, np.float32(1.2), away) if self.streaked else away
            color[:, road] = self.street.asphalt(along[road], aside[road], crossing[road])
        return color


@dataclass(frozen=True)
class Slabs:
    """A pavement: square slabs with joints, and a pale kerb on the side of the road."""

    kerb: float  # |y| of its outer edge
    size: float = 0.8

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        x, y, _ = points
        shade = 0.72 + 0.3 * cell(x / self.size, y / self.size, 9) + 0.3 * fractal(x, y, 5.0)
        joint = (x % self.size < 0.05) | (y % self.size < 0.05)
        color = mix(speckle(rgb("a89f94"), shade), rgb("6b645c"), joint)
        edge = (np.abs(y) < self.kerb + 0.22) | (np.abs(normals[2]) < 0.5)
        return mix(color, speckle(rgb("cfc9bd"), 0.75 + 0.3 * cell(x / 1.1, 0 * y, 2)), edge)


@dataclass(frozen=True)
class Tiles:
    """A tiled roof: rows of tiles by height, each tile its own shade."""

    color: Color
    ridge_along_x: bool
    row: float = 0.34

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        along = points[0] if self.ridge_along_x else points[1]
        rows = points[2] / (0.7 * self.row)
        tiles = along / 0.42 + 0.5 * (np.floor(rows) % 2)
        shade = 0.55 + 0.5 * cell(tiles, rows, 3) + 0.35 * fractal(along, 1.6 * points[2], 5.0)
        return speckle(self.color, shade * np.where(rows % 1.0 < 0.2, np.float32(0.6), np.float32(1)))


@dataclass(frozen=True)
class Stripes:
    """Cloth in two colours, striped along x: awnings."""

    color: Color

    def __call__(self, points: Floats, _normals: Floats) -> Floats:
        return mix(rgb("efe9da"), self.color, points[0] % 0.7 < 0.35)


@dataclass(frozen=True)
class Cabin:
    """The upper part of a car from `low` to `high`: glass between a roof and pillars at x in `pillars`."""

    color: Color
    low: float
    high: float
    pillars: tuple[float, ...]

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        x, _, z = points
        glass = (z > self.low) & (z < self.high) & (np.abs(normals[2]) < 0.85)
        for pillar in self.pillars:
            glass &= (np.abs(x - pillar) > 0.06) | (np.abs(normals[0]) > 0.5)
        return mix(self.color, speckle(rgb("33424f"), 0.7 + (z - self.low) / (self.high - self.low)), glass)
