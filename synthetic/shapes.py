"""The solids that a town is made of, and where a ray meets them.

World: metres, z up. Arrays hold one component per row, (3, N): elementwise arithmetic on rows is quick and
gives the same bits for any number of threads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from panolog.synthetic.noise import Floats

Paint = Callable[[Floats, Floats], Floats]  # points (3, N), unit normals (3, N) -> linear RGB albedo (3, N)
Vector = Sequence[float] | NDArray[np.float64]  # (3,)
Plane = tuple[Vector, Vector]  # outward, a point on it


@dataclass(frozen=True, eq=False)
class Convex:
    """The points x with normals @ x <= offsets."""

    normals: Floats  # (F, 3) unit, outward
    offsets: Floats  # (F,)
    center: Floats  # (3,) of a sphere around it
    radius: float  # infinite where it has no end
    paint: Paint

    def enter(self, origins: Floats, directions: Floats) -> Floats:
        """Distance (N,) to where rays from outside enter, inf for a miss.

        `origins` is (3, 1) or (3, N), `directions` (3, N).
        """
        enter = np.full(directions.shape[1], -np.inf, np.float32)
        leave = np.full(directions.shape[1], np.inf, np.float32)
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            # Never exactly 0: a ray along a face leaves far ahead if it runs inside, far behind if outside.
            speed = dot(normal, directions) + np.float32(1e-12)
            distance = (offset - dot(normal, origins)) / speed
            np.maximum(enter, np.where(speed < 0, distance, np.float32(-np.inf)), out=enter)
            np.minimum(leave, np.where(speed > 0, distance, np.float32(np.inf)), out=leave)
        return np.where((enter < leave) & (enter > 1e-3), enter, np.float32(np.inf))

    def normal(self, points: Floats) -> Floats:
        """Unit normals (3, N) of the faces nearest to points (3, N) of the surface."""
        height = np.stack(
            [dot(normal, points) - offset for normal, offset in zip(self.normals, self.offsets, strict=True)]
        )
        normals: Floats = self.normals[np.argmax(height, axis=0)].T
        return normals


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An axis-aligned ellipsoid."""

    center: Floats  # (3,)
    axes: Floats  # (3,) half lengths
    paint: Paint

    @property
    def radius(self) -> float:
        """The radius of a sphere around the shape."""
        return float(self.axes.max())

    def enter(self, origins: Floats, directions: Floats) -> Floats:
        """The distance at which each ray enters, as `Convex.enter` has it."""
        start = (origins - self.center[:, None]) / self.axes[:, None]
        step = directions / self.axes[:, None]
        a, b, c = dot(step, step), dot(start, step), dot(start, start) - 1
        root = b * b - a * c
        distance = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (distance > 1e-3), distance, np.float32(np.inf))

    def normal(self, points: Floats) -> Floats:
        """Unit normals (3, N) at points (3, N) of the surface."""
        gradient = (points - self.center[:, None]) / (self.axes * self.axes)[:, None]
        return gradient / np.sqrt(dot(gradient, gradient))


Shape = Convex | Ellipsoid


def dot(a: Floats, b: Floats) -> Floats:
    """Scalar products (N,) of vectors in the rows of (3, N) or (3, 1), `a` also one vector (3,)."""
    axes = range(3) if a.ndim > 1 else np.flatnonzero(a)  # most normals are along an axis
    terms: list[Floats] = [a[axis] * b[axis] for axis in axes]
    return sum(terms[1:], start=terms[0])


def ellipsoid(center: Vector, axes: Vector, paint: Paint) -> Ellipsoid:
    """An ellipsoid with the given centre and half lengths (x, y, z)."""
    return Ellipsoid(np.array(center, np.float32), np.array(axes, np.float32), paint)


@dataclass(frozen=True, eq=False)
class Moved:
    """The paint of a shape that stands elsewhere: looked up where the shape was made."""

    paint: Paint
    turn: NDArray[np.float32]  # (3, 3) from where it was made to where it is
    shift: Floats  # (3,) metres

    def __call__(self, points: Floats, normals: Floats) -> Floats:
        """The colours of points, as `Paint` has them."""
        back = self.turn.T
        return self.paint(back @ (points - self.shift[:, None]), back @ normals)


def moved(shapes: Sequence[Shape], x: float, y: float, quarters: int = 0) -> list[Shape]:
    """The shapes, turned by so many quarters of a circle about the z axis, then moved by (x, y) metres."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    shift = np.array([x, y, 0], np.float32)
    paints: dict[int, Moved] = {}  # shapes that share a paint still do
    return [_moved(shape, turn, shift, paints) for shape in shapes]


def _moved(shape: Shape, turn: NDArray[np.float32], shift: Floats, paints: dict[int, Moved]) -> Shape:
    paint = paints.setdefault(id(shape.paint), Moved(shape.paint, turn, shift))
    center = turn @ shape.center + shift
    if isinstance(shape, Ellipsoid):
        return replace(shape, center=center, axes=np.abs(turn) @ shape.axes, paint=paint)
    normals = shape.normals @ turn.T
    return replace(
        shape, center=center, normals=normals, offsets=shape.offsets + normals @ shift, paint=paint
    )


def convex(planes: Sequence[Plane], paint: Paint) -> Convex:
    """The solid behind `planes`, each an outward direction and a point on it; together they enclose it."""
    normals = np.array([normal for normal, _ in planes], np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (normals * np.array([point for _, point in planes])).sum(axis=1)
    corners = _corners(normals, offsets)
    center = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.linalg.norm(corners - center, axis=1).max())
    return Convex(
        normals.astype(np.float32), offsets.astype(np.float32), center.astype(np.float32), radius, paint
    )


def _corners(normals: NDArray[np.float64], offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, 3) the corners of a convex solid: where three planes meet and no other cuts the point off."""
    triples = np.array(list(combinations(range(len(normals)), 3)))
    triples = triples[np.abs(np.linalg.det(normals[triples])) > 1e-6]
    points = np.linalg.solve(normals[triples], offsets[triples][:, :, None])[:, :, 0]
    return points[(points @ normals.T <= offsets + 1e-6).all(axis=1)]


def box(lower: Vector, upper: Vector, paint: Paint) -> Convex:
    """An axis-aligned box between two corners."""
    return convex(
        [(sign * axis, corner) for corner, sign in ((lower, -1), (upper, 1)) for axis in np.eye(3)], paint
    )
