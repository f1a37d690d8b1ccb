"""Strips: what images show within a margin of a face between blocks, and what is measured in them.

A pixel's point is where the model's depth says. Pixels count by their area on the sphere.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.partition.bounds import Aabb
from panolog.partition.faces import Plane
from panolog.renderer.camera import Camera
from panolog.renderer.render import SH_DEGREE, render, to_bytes
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import exposed
from panolog.scene.projection import rays_of_fractions
from panolog.workers.metrics import decibel, sphere_weights

_CHUNK = 2**18  # pixels whose points are in memory at a time
_OPAQUE = 0.5  # accumulated opacity from which a pixel has a point
_FAR = 2.0  # half extents of the box up to which points count: what is farther is sky, or seen from far away
_LEAST = 4.0  # pixels at the equator that a patch needs on each side of a face

Array = NDArray[np.float64]
Colors = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Look:
    """A camera that looks at a face: a training panorama, or a virtual one."""

    rotation: Array  # (3, 3) world-to-camera
    center: Array  # (3,) world units
    row: int | None = None  # of scene.panoramas; None = virtual


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model shows to a camera, in the host's memory: an image (H, W), or some pixels (S,) of it."""

    color: NDArray[np.uint8]  # (..., 3) RGB
    alpha: NDArray[np.float32]  # (...) accumulated opacity
    distance: NDArray[np.float32]  # (...) world units from the camera; 0 = nothing

    def at(self, pixels: NDArray[np.int64]) -> "Seen":
        """What is seen at some pixels (S,) of an image, row by row."""
        return Seen(
            self.color.reshape(-1, 3)[pixels], self.alpha.ravel()[pixels], self.distance.ravel()[pixels]
        )


@dataclass(frozen=True, eq=False)
class Strip:
    """The S pixels of an image within a margin of a face."""

    pixels: NDArray[np.int64]  # (S,) of the image, row by row
    offsets: Array  # (S,) world units above the face
    points: Array  # (S, 3) world units
    area: Array  # (S,) on the sphere, 1 at the equator
    seen: Seen  # what the model shows there


def see(model: Gaussians, look: Look, width: int, near: float, exposure: Tensor | None = None) -> Seen:
    """Renders a panorama. Args: width in pixels; near in world units; exposure (2, 3), `View.exposure`."""
    camera = Camera.of(look.rotation, -look.rotation @ look.center, width, width // 2)
    with torch.no_grad():
        seen = render(model, camera, sh_degree=SH_DEGREE, near=near)
    alpha, inverse = seen.alpha.cpu().numpy(), seen.inverse_depth.cpu().numpy()
    distance = np.divide(alpha, inverse, out=np.zeros_like(alpha), where=(alpha >= _OPAQUE) & (inverse > 0))
    color = exposed(torch.from_numpy(to_bytes(seen.color)), exposure).numpy()
    return Seen(color, alpha, distance)


def strip_of(
    face: Plane, aabb: Aabb, margin: float, look: Look, seen: Seen, mask: Tensor | None = None
) -> Strip:
    """The strip of a face. Args: margin in world units on each side; mask (H, W) bool, True = counts."""
    width = seen.color.shape[1]
    usable = seen.distance > 0
    if mask is not None:
        usable &= mask.cpu().numpy()
    candidates = np.flatnonzero(usable)
    weights = sphere_weights(len(usable))
    parts = [_part(face, aabb, margin, look, seen, candidates[:0])]
    for start in range(0, len(candidates), _CHUNK):
        parts.append(_part(face, aabb, margin, look, seen, candidates[start : start + _CHUNK]))
    pixels, offsets, points = (np.concatenate(values) for values in zip(*parts, strict=True))
    return Strip(pixels, offsets, points, weights[pixels // width], seen.at(pixels))


def _part(
    face: Plane, aabb: Aabb, margin: float, look: Look, seen: Seen, pixels: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Pixels, offsets and points of those of some pixels that are in the strip."""
    # No matrix product: how it is split among threads may change its last bit.
    rays = np.einsum("pi,ij->pj", directions(pixels, seen.color.shape[1]), look.rotation)
    points = look.center + seen.distance.ravel()[pixels, None] * rays
    offsets = face.offsets(points, aabb)
    near = np.abs((points - aabb.center) / aabb.half).max(axis=1, initial=0.0) <= _FAR
    inside = near & (np.abs(offsets) <= margin)  # false for NaN
    return pixels[inside], offsets[inside], points[inside]


def directions(pixels: NDArray[np.int64], width: int) -> Array:
    """(P, 3) unit rays in camera axes of pixels of a panorama, row by row (app. B)."""
    v, u = np.divmod(pixels, width)
    return rays_of_fractions((np.stack([u, v], axis=1) + 0.5) / (width, width // 2))


@dataclass
class Errors:
    """Sums over strips: of squared errors of colours in [0, 1], and of steps of the errors at the face."""

    error: float = 0.0
    area: float = 0.0
    step: float = 0.0
    weight: float = 0.0

    def add(self, face: Plane, strip: Strip, color: Colors, truth: Colors, side: float) -> None:
        """Adds a strip. Args: color and truth (S, 3) uint8, render and photograph; side of a patch."""
        residual = (color.astype(np.float64) - truth) / 255
        self.error += float((strip.area * (residual**2).mean(axis=1)).sum())
        self.area += float(strip.area.sum())
        step, weight = _steps(face, strip, residual, side)
        self.step += step
        self.weight += weight

    def join(self, other: "Errors") -> None:
        """Adds the sums of others."""
        self.error, self.area = self.error + other.error, self.area + other.area
        self.step, self.weight = self.step + other.step, self.weight + other.weight

    @property
    def means(self) -> tuple[float | None, float | None]:
        """The root mean squared error and the mean step; None where nothing was seen."""
        error = float(np.sqrt(self.error / self.area)) if self.area else None
        return error, self.step / self.weight if self.weight else None


def _steps(face: Plane, strip: Strip, residual: Array, side: float) -> tuple[float, float]:
    """The steps of the residual (S, 3) at a face, each weighed by its area, and the sum of weights.

    The face is cut into square patches. A step is the difference of the mean residuals on both sides of one:
    what the photograph does there, and errors that continue across the face, cancel.
    """
    along = [axis for axis in range(3) if axis != face.axis]
    cells = np.floor(strip.points[:, along] / side).astype(np.int64)
    patches, of = np.unique(cells, axis=0, return_inverse=True)
    areas, means = [], []
    for inside in (strip.offsets < 0, strip.offsets >= 0):
        own, weights = of.ravel()[inside], strip.area[inside]
        area = np.bincount(own, weights, len(patches))
        sums = [np.bincount(own, weights * residual[inside, c], len(patches)) for c in range(3)]
        areas.append(area)
        means.append(np.stack(sums, axis=1) / np.maximum(area, _LEAST)[:, None])
    weight = np.minimum(*areas)
    weight[weight < _LEAST] = 0.0
    steps = np.abs(means[0] - means[1]).mean(axis=1)
    return float((weight * steps).sum()), float(weight.sum())


@dataclass
class Difference:
    """Sums over strips of how far what two blocks show differs."""

    area: float = 0.0
    sums: Array = field(default_factory=lambda: np.zeros(4))  # colours, their squares, depths, opacities

    def add(self, strip: Strip, below: Seen, above: Seen) -> None:
        """Adds a strip. Args: what both blocks show in it; depths are relative to those of the strip."""
        area = strip.area
        colors = [seen.color.astype(np.float64) / 255 for seen in (below, above)]
        distances = [seen.distance.astype(np.float64) for seen in (below, above, strip.seen)]
        opacity = np.abs(below.alpha.astype(np.float64) - above.alpha)
        apart = np.abs(colors[0] - colors[1])
        depth = np.abs(distances[0] - distances[1]) / distances[2]
        values = apart.mean(axis=1), (apart**2).mean(axis=1), depth.clip(0, 1), opacity
        self.area += float(area.sum())
        self.sums += [float((area * value).sum()) for value in values]

    @property
    def means(self) -> dict[str, float | None]:
        """The means; None where nothing was seen."""
        if not self.area:
            return dict.fromkeys(("color", "psnr", "depth", "opacity"))
        color, squared, depth, opacity = (self.sums / self.area).tolist()
        return {"color": color, "psnr": decibel(squared), "depth": depth, "opacity": opacity}
