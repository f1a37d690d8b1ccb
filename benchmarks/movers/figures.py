"""Figures of people, drawn into panoramas where they would stand.

A figure is a picture on a vertical plane that faces the camera: head, hair, torso, arms and legs as capsules
with stripes and shading, and a soft shadow on the ground. Each has colours, gait and stature of its own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FINER = 2  # samples for each pixel, along both axes
_SHADOW = 0.5  # of the light that is left in its middle
_ROOM = 0.35  # statures to each side that a figure may take


@dataclass(frozen=True, eq=False)
class Standpoint:
    """From where a figure is seen: the axes are those of the plane that it is on."""

    axes: Array  # (3, 3) rows right, up, forward (horizontal, to the figure) in camera axes
    eye: float  # of the camera above the ground, world units
    distance: float  # from the camera to the figure along the ground, world units


@dataclass(frozen=True)
class Figure:
    """How one person looks."""

    stature: float  # world units
    stride: float  # of each foot from the middle, statures
    stripes: float  # radians of the torso's pattern for each stature, 0 = plain
    colors: tuple[tuple[float, float, float], ...]  # RGB in [0, 1] of skin, hair, torso, legs

    @staticmethod
    def drawn(random: np.random.Generator, eye: float) -> "Figure":
        """One of any looks. Args: eye, height of the camera, which is held about as high as people are."""
        skin = np.array([0.85, 0.65, 0.52]) * random.uniform(0.35, 1.0)
        hair, legs = random.uniform(0.03, 0.35, (2, 3))
        torso = random.uniform(0.0, 1.0, 3) ** random.uniform(0.5, 2.0)
        stripes = float(random.choice([0.0, 60.0, 110.0]))
        colors = tuple((float(r), float(g), float(b)) for r, g, b in (skin, hair, torso, legs))
        return Figure(eye * random.uniform(0.8, 0.98), float(random.uniform(0.02, 0.13)), stripes, colors)


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure as a camera sees it, for each pixel (H, W) of the panorama."""

    color: Array  # (H, W, 3) RGB in [0, 1], premultiplied by `cover`
    cover: Array  # share of the pixel that the body covers
    light: Array  # share of the light that its shadow leaves
    distance: Array  # from the camera, world units, where it covers anything


def draw(figure: Figure, at: Standpoint, width: int) -> Picture:
    """A figure in a panorama (width / 2, width). Equal figures give equal pictures."""
    fine = width * FINER
    azimuth = ((np.arange(fine) + 0.5) / fine - 0.5) * 2 * np.pi
    elevation = ((np.arange(fine // 2) + 0.5) / (fine // 2) - 0.5) * np.pi
    level = np.cos(elevation)[:, None]
    rays = np.stack(
        [level * np.sin(azimuth), np.sin(elevation)[:, None] + 0 * azimuth, level * np.cos(azimuth)], axis=-1
    )
    right, up, forward = np.moveaxis(rays @ at.axes.T, -1, 0)
    reach = at.distance / np.where(forward > 1e-3, forward, np.inf)
    x, y = right * reach / figure.stature, (at.eye + up * reach) / figure.stature
    near = (forward > 1e-3) & (np.abs(x) < _ROOM) & (y > -0.05) & (y < 1.05)
    color, cover = np.zeros((*near.shape, 3)), np.zeros(near.shape)
    color[near], cover[near] = _body(figure, x[near], y[near])
    light = _light(figure, at, right, up, forward)
    distance = np.where(near, reach, 0.0)
    size = (fine // 2 // FINER, FINER, width, FINER)
    colors = (color * cover[..., None]).reshape(*size, 3).mean((1, 3))
    covers, lights = (each.reshape(size).mean((1, 3)) for each in (cover, light))
    return Picture(colors, covers, lights, distance.reshape(size).max((1, 3)))


def _body(figure: Figure, x: Array, y: Array) -> tuple[Array, Array]:
    """Colours (M, 3) and cover (M,), 0 or 1, at points of the plane in statures from between the feet."""
    skin, hair, torso, legs = (np.array(color) for color in figure.colors)
    color, cover = np.zeros((len(x), 3)), np.zeros(len(x))
    sway, stride = 0.6 * figure.stride, figure.stride
    parts = [  # from back to front: two ends, radius, colour, pattern
        ((0.16, 0.80), (0.17 + sway, 0.47), 0.037, torso, 0.0),
        ((-0.16, 0.80), (-0.17 - sway, 0.47), 0.037, torso, 0.0),
        ((0.17 + sway, 0.47), (0.17 + sway, 0.43), 0.033, skin, 0.0),
        ((-0.17 - sway, 0.47), (-0.17 - sway, 0.43), 0.033, skin, 0.0),
        ((0.06, 0.50), (0.05 + stride, 0.05), 0.058, legs, 0.0),
        ((-0.06, 0.50), (-0.05 - stride, 0.05), 0.058, legs, 0.0),
        ((0.0, 0.57), (0.0, 0.74), 0.125, torso, figure.stripes),
        ((0.0, 0.84), (0.0, 0.90), 0.045, skin, 0.0),
        ((0.0, 0.91), (0.0, 0.94), 0.062, skin, 0.0),
        ((0.0, 0.955), (0.0, 0.965), 0.058, hair, 0.0),
    ]
    for first, last, radius, paint, stripes in parts:
        apart, across = _capsule(x, y, np.array(first), np.array(last))
        inside = apart < radius
        shade = 1.0 - 0.35 * (across[inside] / radius + 0.4) ** 2
        pattern = 1.0 + 0.3 * np.sign(np.sin(stripes * y[inside])) if stripes else np.ones(int(inside.sum()))
        color[inside] = np.clip(paint * (shade * pattern)[:, None], 0, 1)
        cover[inside] = 1.0
    return color, cover


def _capsule(x: Array, y: Array, first: Array, last: Array) -> tuple[Array, Array]:
    """Distance (M,) of points from a segment, and how far they are to the right of it."""
    along = last - first
    share = ((x - first[0]) * along[0] + (y - first[1]) * along[1]) / float(along @ along)
    foot = first + np.clip(share, 0, 1)[:, None] * along
    return np.hypot(x - foot[:, 0], y - foot[:, 1]), x - foot[:, 0]


def _light(figure: Figure, at: Standpoint, right: Array, up: Array, forward: Array) -> Array:
    """(H, W) what a figure's shadow leaves of the light: an ellipse around its feet."""
    reach = at.eye / np.where(up < -1e-3, -up, np.inf)
    x = (right * reach / figure.stature - 0.12) / 0.34
    z = ((forward * reach - at.distance) / figure.stature) / 0.22
    return np.where(up < -1e-3, 1 - (1 - _SHADOW) * np.clip(1.5 - 1.5 * (x**2 + z**2), 0, 1), 1.0)
