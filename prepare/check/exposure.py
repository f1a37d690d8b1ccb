"""Differences of exposure between panoramas, measured where several of them have seen the same points.

A point looks alike in all panoramas but for their exposures: the logarithm of what panorama v shows at point
p is g_v + a_p, with the log gain g_v in linear light and what the point itself reflects, a_p. Least squares
over all observations gives both for each channel; Tukey's weights leave out what is hidden, moves or shines.

Where the files of all panoramas say by EXIF how they were exposed, gains are tied weakly to that: points
decide where there are some, EXIF between panoramas that share none. Panoramas of a walk, whose names are
numbered as frames of a video are, are tied so that the exposure changes smoothly.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from panolog.prepare.check.evidence import Array, bilinear, in_threads, points_seen, project
from panolog.prepare.provenance import sampled
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import SceneError
from panolog.scene.image_files import decode_panorama
from panolog.scene.images import CURVE, TOE, load_layers
from panolog.scene.model import Panorama, Scene

WIDTH = 1024  # pixels of the panoramas as they are measured
_QUICK = 512  # the same where they are likely to be alike: noise is larger there, and with it all differences
POINTS = 4000  # of each panorama, at most
DIFFERS = 0.15  # stops rms: more than the measurement errs, 0.11 in a flight through haze over sunlit walls
FEWEST = 200  # observations of points that others have seen too, of a panorama that is measured
_DARK, _BRIGHT = 8 / 255, 247 / 255  # outside, a sample may be clipped
_PIECE, _LEVELS = 2.0, 5  # pixels at WIDTH: the radius of a sample; radii of 1, 2, 4, … are blurred
_ROUNDS, _TUKEY = 8, 4.685  # of the reweighting; its constant in robust standard deviations
_TIE = 0.25  # observations' worth: to the exposure of the panorama before, in the order of names, over EXIF
_SMOOTH = 1.0  # the same: to what lies between the panoramas before and after, in a numbered walk
_NOMINAL = 0.1 * np.log(2)  # natural logarithm: times and ISO are nominal, rounded to thirds of a stop
_NUMBERED = re.compile(r"(.*?)([0-9]{1,15})\.[^./]*")
_LEAST = 0.004  # natural logarithm: the robust deviation is not taken to be less, as pictures have 8 bits


@dataclass(frozen=True, eq=False)
class Exposures:
    """What was measured of K panoramas."""

    log_gain: Array  # (K, 3) natural logarithms of gains in linear light, RGB, their mean 0
    sigma: Array  # (K,) standard deviation of each, mean over the channels
    observations: NDArray[np.int64]  # (K,) of points that others have seen too

    @property
    def stops(self) -> Array:
        """(K,) of each panorama over the mean, mean of the channels."""
        stops: Array = self.log_gain.mean(axis=1) / np.log(2)
        return stops

    @property
    def tints(self) -> Array:
        """(K, 3) factors of the channels besides the mean one, in linear light."""
        tints: Array = np.exp(self.log_gain - self.log_gain.mean(axis=1, keepdims=True))
        return tints

    @property
    def spread(self) -> float:
        """Root mean square of all log gains, in stops."""
        return float(np.sqrt((self.log_gain**2).mean()) / np.log(2))


def differing_exposures(scene: Scene, rows: Sequence[int]) -> Exposures | None:
    """`measure_exposures`; None also where they differ by less than `DIFFERS`, which is quicker."""
    for width in sorted({min(_QUICK, scene.width), min(WIDTH, scene.width)}):
        found = measure_exposures(scene, rows, width)
        if found is None or found.spread < DIFFERS:
            return None
    return found


def measure_exposures(scene: Scene, rows: Sequence[int], width: int = WIDTH) -> Exposures | None:
    """The exposures of some panoramas of a scene.

    None if most of them have seen too few common points, unless all have EXIF that says their exposures. A
    panorama that cannot be decoded counts as one that has seen nothing.

    Args: width of the panoramas as they are measured, pixels, at most.
    """
    width = min(width, scene.width)
    views, points, values = list[NDArray[np.int64]](), list[NDArray[np.int64]](), list[Array]()
    seen = [points_seen(scene, scene.panoramas[row], POINTS) for row in rows]
    far = _farthest(scene, seen, rows)
    samples = in_threads(lambda row, some: _samples(scene, row, some, far, width), rows, seen)
    for number, (found, colors) in enumerate(samples):
        views.append(np.full(len(found), number))
        points.append(found)
        values.append(colors)
    view, point, value = np.concatenate(views), np.concatenate(points), np.concatenate(values)
    _, point, often = np.unique(point, return_inverse=True, return_counts=True)
    shared = often[point] > 1
    view, value = view[shared], value[shared]
    _, point = np.unique(point[shared], return_inverse=True)
    counts = np.bincount(view, minlength=len(rows))
    expected = _expected(scene, rows)
    if expected is None and (counts >= FEWEST).sum() < max(2, len(rows) / 2):
        return None
    ties = _ties([scene.panoramas[row].name for row in rows])
    prior = np.zeros(len(rows)) if expected is None else expected
    solved = [_solve(view, point, value[:, channel], prior, ties) for channel in range(3)]
    log_gain = np.stack([gains for gains, _ in solved], axis=1)
    return Exposures(log_gain, np.mean([sigma for _, sigma in solved], axis=0), counts)


def _farthest(scene: Scene, seen: Sequence[NDArray[np.int64]], rows: Sequence[int]) -> Array:
    """(P,) the distance of each point from the farthest panorama that has seen it."""
    far = np.zeros(len(scene.points))
    for row, points in zip(rows, seen, strict=True):
        away = np.linalg.norm(scene.points[points] - scene.panoramas[row].center, axis=1)
        np.maximum.at(far, points, away)
    return far


def _samples(
    scene: Scene, row: int, seen: NDArray[np.int64], far: Array, width: int
) -> tuple[NDArray[np.int64], Array]:
    """Rows (M,) of points that a panorama has seen, and the logarithms (M, 3) of what it shows there.

    A sample is a mean over about the same piece of the surface in all panoramas, `_PIECE` pixels for the
    farthest: what a single pixel shows depends on the distance where there is a pattern.
    """
    panorama = scene.panoramas[row]
    try:
        stack, mask = _blurred(panorama, width), load_layers(panorama, row, width).mask
    except SceneError:
        return seen[:0], np.empty((0, 3))
    local = scene.points[seen] @ panorama.rotation.T + panorama.translation
    where = project(local)
    radius = _PIECE * width / WIDTH * far[seen] / np.maximum(np.linalg.norm(local, axis=1), 1e-12)
    level = np.clip(np.log2(radius), 0, _LEVELS - 1)
    values = np.stack([bilinear(blurred, where) for blurred in stack])
    lower = np.minimum(level.astype(int), _LEVELS - 2)
    part, each = (level - lower)[:, None], np.arange(len(seen))
    colors = values[lower, each] * (1 - part) + values[lower + 1, each] * part
    used = ((colors > _DARK) & (colors < _BRIGHT)).all(axis=1)
    if mask is not None:
        used &= sampled(mask.numpy(), where * (1, 2))
    return seen[used], CURVE * np.log(colors[used] + TOE)


def _blurred(panorama: Panorama, width: int) -> list[NDArray[np.float32]]:
    """A picture (H, W, 3) in [0, 1] blurred by standard deviations of 1, 2, 4, … pixels."""
    picture = (decode_panorama(panorama.image, width) / 255).astype(np.float32)
    margin = min(width, 3 * 2 ** (_LEVELS - 1))
    around = np.concatenate([picture[:, -margin:], picture, picture[:, :margin]], axis=1)
    stack = []
    for level in range(_LEVELS):
        blurred = cv2.GaussianBlur(around, (0, 0), 2.0**level, borderType=cv2.BORDER_REPLICATE)
        stack.append(np.asarray(blurred[:, margin : margin + width], np.float32))
    return stack


def _expected(scene: Scene, rows: Sequence[int]) -> Array | None:
    """(K,) natural logarithms of gains by EXIF, their mean 0; None unless it says all of them."""
    stops = []
    for row in rows:
        try:
            found = read_exif(scene.panoramas[row].image).exposure_stops
        except (OSError, SceneError):
            return None
        if found is None:
            return None
        stops.append(found)
    gains: Array = (np.array(stops) - np.mean(stops)) * np.log(2)
    return gains


def _solve(
    view: NDArray[np.int64], point: NDArray[np.int64], value: Array, expected: Array, ties: csr_array
) -> tuple[Array, Array]:
    """(K,) log gains of mean 0 and their standard deviations, from observations (N,) of points by views.

    Args: expected (K,) log gains, about which `ties` (K, K), normal equations, hold them.
    """
    count = len(expected)
    if not len(value):
        return expected - expected.mean(), np.full(count, _NOMINAL)
    gains, weight = expected, np.ones(len(value))
    shape = (count, int(point.max()) + 1)
    for _ in range(_ROUNDS):
        table = csr_array((weight, (view, point)), shape=shape)
        total = np.maximum(table.sum(axis=0), 1e-9)
        among = table @ diags_array(1 / total) @ table.T
        normal = (diags_array(table.sum(axis=1)) - among + ties).tocsc()
        mean = np.bincount(point, weight * value, shape[1]) / total
        right = np.bincount(view, weight * (value - mean[point]), count) + ties @ expected
        gains = spsolve(normal, right)
        gains -= gains.mean()
        left = value - gains[view]
        left = left - (np.bincount(point, weight * left, shape[1]) / total)[point]
        deviation = max(_LEAST, 1.4826 * float(np.median(np.abs(left[weight > 0]))))
        weight = np.clip(1 - (left / (_TUKEY * deviation)) ** 2, 0, None) ** 2
    information = np.maximum(np.bincount(view, weight, count), 1.0)
    return gains, deviation / np.sqrt(information)


def _ties(names: Sequence[str]) -> csr_array:
    """(K, K) normal equations of weak ties between neighbours, which also fix the mean."""
    count = len(names)
    bends = [(k, bend) for k in range(1, count - 1) if (bend := _bend(names[k - 1 : k + 2])) is not None]
    steps = _rows([(k, (-1.0, 1.0)) for k in range(count - 1)], count)
    curves = _rows([(k - 1, bend) for k, bend in bends], count)
    held = 1e-6 * diags_array(np.ones(count))
    return csr_array(_TIE * (steps.T @ steps) + _SMOOTH * (curves.T @ curves) + held)


def _rows(rows: Sequence[tuple[int, Sequence[float]]], count: int) -> csr_array:
    """(R, count) of rows with some values from a column on."""
    values = [value for _, some in rows for value in some]
    columns = [first + at for first, some in rows for at in range(len(some))]
    number = [row for row, (_, some) in enumerate(rows) for _ in some]
    return csr_array((values, (number, columns)), shape=(len(rows), count))


def _bend(names: Sequence[str]) -> tuple[float, float, float] | None:
    """Factors of three frames: the middle one minus what lies between the others; None if it is no walk."""
    found = [_NUMBERED.fullmatch(name) for name in names]
    if not all(found):
        return None
    (one, first), (two, second), (three, third) = ((it[1], int(it[2])) for it in found if it)
    if not (one == two == three and first < second < third):
        return None
    before = (third - second) / (third - first)
    return -before, 1.0, before - 1


def describe(names: Sequence[str], found: Exposures) -> str:
    """The measurement as one line. Args: names of the panoramas."""
    stops, tints = found.stops, np.abs(np.log(found.tints)).max()
    low, high = int(stops.argmin()), int(stops.argmax())
    source = "" if found.observations.any() else ", by EXIF alone"
    return (
        f"exposure: {found.spread:.2f} stops rms, from {stops[low]:+.2f} ({names[low]})"
        f" to {stops[high]:+.2f} ({names[high]}), tints up to {np.expm1(tints):.0%}{source}"
    )
