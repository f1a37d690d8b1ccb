"""The two lenses of a camera: where a picture of both shows a direction, and how that is kept as JSON.

Directions are in body axes, x right, y down, z forward, as those of the panorama: the first lens looks at its
middle, the second one back. A picture of a lens has x to the right and y down from its left upper corner, in
pixels. A direction is r = focal · (θ + bend θ³ + edge θ⁷) from the centre, where θ is its angle from the
axis: the last term bends the outermost degrees alone, as these lenses do.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import FiniteFloat, TypeAdapter
from scipy.spatial.transform import Rotation

from panolog.scene.errors import SceneError

Array = NDArray[np.float64]
Up = Literal["up", "right", "down", "left"]
APPROXIMATE = (
    "stitched: the lenses are taken as equidistant within their circles, which may bend straight lines by a"
    " degree or two; panoramas that the camera's own program exports are more exact"
)
WIDEST = 16_384  # pixels of a panorama
_STEPS = 8  # of Newton's method, which doubles the digits in each
_MOST = 2.1  # radians from the axis, more than any lens shows
_LARGEST = 1_000_000  # bytes of a file of lenses
_BEHIND = np.diag([-1.0, 1.0, -1.0])  # the turn that the second lens has against the first


@dataclass(frozen=True)
class Lens:
    """One lens, as it is in its own picture."""

    x: FiniteFloat  # of its centre, in pixels
    y: FiniteFloat
    focal: FiniteFloat  # pixels per radian on the axis
    bend: FiniteFloat = 0.0  # how the scale changes with the angle from the axis
    edge: FiniteFloat = 0.0
    turn: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, 0.0)  # rotation vector in radians
    behind: bool = False  # whether it looks back; `turn` is what it has besides that

    @property
    def rotation(self) -> Array:
        """(3, 3) from body axes to those of the lens."""
        turned: Array = Rotation.from_rotvec(self.turn).as_matrix()
        return turned @ _BEHIND if self.behind else turned

    def project(self, directions: Array) -> tuple[Array, Array]:
        """(..., 2) pixels and (...) angles from the axis in radians of unit vectors (..., 3)."""
        local = directions @ self.rotation.T.astype(directions.dtype)
        across = np.hypot(local[..., 0], local[..., 1])
        angle = np.arctan2(across, local[..., 2])
        scale = self.radius(angle) / np.maximum(across, 1e-12)
        pixels = local[..., :2] * scale[..., None] + np.array([self.x, self.y], directions.dtype)
        return pixels, angle

    def directions(self, pixels: Array) -> Array:
        """(N, 3) unit vectors in body axes of pixels (N, 2): the inverse of `project`."""
        away = pixels - (self.x, self.y)
        radius = np.hypot(*away.T)
        angle = radius / self.focal
        for _ in range(_STEPS):
            slope = 1 + 3 * self.bend * angle**2 + 7 * self.edge * angle**6
            step = (self.radius(angle) - radius) / (self.focal * np.maximum(slope, 0.2))
            angle = np.clip(angle - step, 0, _MOST)
        flat = away / np.maximum(radius, 1e-12)[:, None] * np.sin(angle)[:, None]
        return np.column_stack([flat, np.cos(angle)]) @ self.rotation

    def radius(self, angle: Array) -> Array:
        """Pixels from the centre at an angle from the axis in radians."""
        square = angle * angle
        return np.asarray(self.focal * angle * (1 + square * (self.bend + self.edge * square * square)))

    def scaled(self, factor: float) -> "Lens":
        """The lens for its picture resized by a factor."""
        return replace(self, x=self.x * factor, y=self.y * factor, focal=self.focal * factor)


@dataclass(frozen=True)
class Pair:
    """Both lenses of a camera."""

    lenses: tuple[Lens, Lens]
    size: tuple[int, int]  # width and height of the picture of each
    reach: FiniteFloat  # radians from its axis up to which a lens shows something
    fall: tuple[FiniteFloat, ...] = ()  # of light towards the rim: see `light`
    up: Up = "up"  # where up is in the circle of the first lens
    camera: str = ""  # that made the pictures, by their EXIF
    error: FiniteFloat = 0.0  # median difference of the two in what both show, in degrees

    @property
    def width(self) -> int:
        """Pixels of the panorama that has all that the lenses resolve; a multiple of 4."""
        quarter = max(float(lens.radius(np.array(np.pi / 2))) for lens in self.lenses)
        return min(round(quarter) * 4, WIDEST)

    def resized(self, size: tuple[int, int]) -> "Pair":
        """The pair for pictures resized to this width and height, by the factor of the widths."""
        return replace(self.scaled(size[0] / self.size[0]), size=size)

    def scaled(self, factor: float) -> "Pair":
        """The pair for pictures resized by a factor."""
        one, other = (lens.scaled(factor) for lens in self.lenses)
        size = (max(1, round(self.size[0] * factor)), max(1, round(self.size[1] * factor)))
        return replace(self, lenses=(one, other), size=size)

    def light(self, angle: Array) -> Array:
        """Values of a lens's picture over those at its middle, at angles from the axis in radians.

        The logarithm has a term of each of `fall`, with even powers of the angle over `reach`; beyond that it
        is constant.
        """
        square = np.minimum(angle / self.reach, 1) ** 2
        return np.asarray(np.exp(-np.polynomial.polynomial.polyval(square, (0.0, *self.fall))))

    def shows(self, pixels: Array, angle: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether a lens shows what it projects to (..., 2) pixels at angles (...); margin in radians."""
        edge = margin * self.lenses[0].focal + 0.5
        inside = (pixels > edge) & (pixels < np.array(self.size) - edge)
        return np.asarray(inside.all(axis=-1) & (angle < self.reach - margin))


_PAIRS = TypeAdapter(list[Pair])


def pairs_as_json(pairs: list[Pair]) -> bytes:
    """The content of a file of lenses."""
    return _PAIRS.dump_json(pairs, indent=1)


def read_pairs(path: Path) -> list[Pair]:
    """What `pairs_as_json` wrote; empty without a file. Raises SceneError if it is damaged."""
    if not path.is_file():
        return []
    try:
        with path.open("rb") as file:
            return _PAIRS.validate_json(file.read(_LARGEST))
    except ValueError as error:
        raise SceneError(
            f"{path}: is no file of lenses of PanoLOG; remove it, or give a new folder"
        ) from error
