"""From what a ray met to a display colour: sun, sky light, haze, and the sky itself."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from panolog.synthetic.noise import Floats, fractal
from panolog.synthetic.paint import column, mix, rgb
from panolog.synthetic.shapes import Shape, dot
from panolog.synthetic.trace import CitySun, Hits, Rays, Sun

SUNLIGHT, SKYLIGHT, BOUNCE = (2.5, 2.05, 1.45), (0.40, 0.48, 0.62), (0.26, 0.22, 0.16)
HAZE = 650.0  # metres


def sky(directions: Floats, sun: Floats) -> Floats:
    """Linear RGB (3, N) of the sky in unit directions (3, N): a gradient, clouds, the sun at `sun` (3,)."""
    x, y, up = directions
    rise = np.clip(up, 0, 1)
    color = mix(rgb("dfe6e6"), rgb("3f7fc6"), 1 - (1 - rise) ** 2.2)
    slant = 1 / (rise + 0.12)
    east, north = x * slant + 4.0, y * slant + 1.25  # blue overhead
    thick = fractal(east, north, 6.5) * 0.75 + fractal(north, east, 2.1) * 0.25
    cover = np.clip((thick - 0.53) / 0.14, 0, 1) * np.clip(rise / 0.12, 0, 1)
    white = mix(rgb("ffffff"), rgb("c8d0d8"), np.clip(5 * thick - 3.6, 0, 1))
    color = mix(color, white, 0.92 * cover * cover * (3 - 2 * cover))
    toward = np.clip(dot(sun, directions), 0, 1)
    glow = 0.35 * toward**24 + 0.9 * toward**400
    return color + column((1.0, 0.86, 0.6)) * glow


def display(linear: Floats) -> Floats:
    """Display RGB in [0, 1] of linear RGB (3, N): a soft shoulder, then gamma 2.2."""
    return (linear * (1 + linear / 6) / (1 + linear / 1.8)) ** np.float32(1 / 2.2) * np.float32(1.02)


def shade(shapes: Sequence[Shape], rays: Rays, hits: Hits, sun: Sun | CitySun) -> Floats:
    """Display RGB (3, N) in [0, 1] of each ray. But for the haze, it does not depend on the viewer."""
    color = np.empty(rays.directions.shape, np.float32)
    order = np.argsort(hits.shape, kind="stable")  # the rays of each shape side by side
    bounds = np.searchsorted(hits.shape[order], np.arange(len(shapes) + 1))
    nothing, order, bounds = order[: bounds[0]], order[bounds[0] :], bounds - bounds[0]
    color[:, nothing] = sky(rays.directions[:, nothing], sun.direction)
    distance = hits.distance[order]
    points = rays.origins + distance * rays.directions[:, order]
    normals = np.empty_like(points)
    met = np.flatnonzero(np.diff(bounds)).tolist()
    for index in met:
        part = slice(bounds[index], bounds[index + 1])
        normals[:, part] = shapes[index].normal(points[:, part])
    albedo = np.empty_like(points)
    for paint, run in groupby(met, key=lambda index: shapes[index].paint):
        members = list(run)
        part = slice(bounds[members[0]], bounds[members[-1] + 1])
        albedo[:, part] = paint(points[:, part], normals[:, part])
    lit = albedo * _light(points, normals, sun.around(rays.origins[:, 0]))
    color[:, order] = mix(lit, rgb("d3dde2"), 1 - np.exp(-distance / np.float32(HAZE)))
    return np.clip(display(color), 0, 1)


def _light(points: Floats, normals: Floats, sun: Sun) -> Floats:
    """Light (3, N) that falls on a surface: the sun unless shaded, more of the sky the more it faces up."""
    facing = np.clip(dot(sun.direction, normals), 0, 1)
    direct = facing * sun.on(points, normals)
    open_sky = 0.5 + 0.5 * normals[2]
    near_ground = 0.72 + 0.28 * np.clip(points[2] / 2.5 + (normals[2] > 0.5), 0, 1)
    ambient = (column(SKYLIGHT) * open_sky + column(BOUNCE) * (1 - open_sky)) * near_ground
    light: Floats = column(SUNLIGHT) * direct + ambient
    return light
