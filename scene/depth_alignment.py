"""Depth alignment (eq. 4): an affine maps a monocular depth map to the scale of the sparse cloud."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from panolog.scene.images import View, pixels
from panolog.scene.model import Panorama, Scene
from panolog.scene.projection import project_to_pixels
from panolog.scene.random_streams import generator

Array = NDArray[np.float64]

MIN_POINTS = 20  # sparse points that an image needs: ten for each unknown of eq. 4
MAX_RESIDUAL = 0.5  # of the points' spread; a map with 1 says no more than a constant
PAIRS = 256  # lines through two points that are tried; with 30 % outliers half of them are sound
TRIAL_POINTS = 2_000  # by which the lines are compared
REFINEMENTS = 20  # reweighted least squares after that
TUKEY = 4.685  # standard deviations beyond which a residual has no weight; Beaton and Tukey 1974
MAD_TO_SIGMA = 1.4826  # for normal errors
# The affine of a scene fits as well as ours if its residual is at most half as large again, and 0.02 more:
# programs fit by different measures, and the points cannot say which of two such lines is better.
AS_GOOD, SLACK = 1.5, 0.02
FEWEST = 5  # points with which an affine of the scene is compared where they are too few for a fit
# Where no panorama says which points it sees. On the street these settings find the affine of a map as well
# as tracks do: tests/scene/test_depth_alignment.py.
MOST_POINTS = 200_000  # of the cloud, evenly chosen
LIKELY_ROUNDS = 3  # of choosing points by a line and fitting it again
COARSE, FINE = (24, 128), 4  # columns of the grid of directions, about two points in a cell; times that
BEHIND_COARSE, BEHIND_FINE = 1.1, 1.2  # a point that is so many times as far as the nearest is hidden
NEAR = 0.2  # by which the logarithm of a map's depth and of a point's may differ if the map shows the point
BANDS = 12  # of latitude, each of 24 cells about 12 degrees wide


@dataclass(frozen=True)
class Alignment:
    """An affine on a monocular prior: inverse radial depth = scale · prior + offset, in 1 / world units."""

    scale: float
    offset: float
    residual: float | None  # median, as a fraction of the median spread of the points' inverse depths
    inliers: int = 0  # points that the affine fits
    points: int = 0  # all points that it was compared with; with none there is no residual
    given: bool = False  # it came with the scene
    note: str = ""  # why it is not the one that came with the scene


class AlignmentError(ValueError):
    """An image's prior cannot be aligned; the message is the reason."""


def fit_affine(prior: Array, inverse: Array, seed: int, share: Array | None = None) -> Alignment:
    """Robust affine of eq. 4: the line of least median residual, refined by Tukey's weights.

    Networks err by a share of the inverse depth, by as much everywhere, or between the two: how errors grow
    with inverse depth is fitted with the line. They are the map's as well as the points'.

    Args:
        prior: (M,) monocular values at M ≥ 2 points.
        inverse: (M,) inverse radial depths 1/r of the same points.
        share: (M,) weight of each point; 1 if left out.

    Raises AlignmentError: the prior is constant.
    """
    share = np.ones(len(prior)) if share is None else share
    line = _least_median(prior, inverse, generator(seed, "depth", "alignment", len(prior)))
    power = 0.0
    for _ in range(REFINEMENTS):
        size = np.abs(inverse) ** power
        error, sigma = _errors(prior, inverse, line, size)
        weight = np.maximum(1 - (error / (TUKEY * sigma)) ** 2, 0) ** 2
        line = _weighted_line(prior, inverse, share * weight / size**2)
        power = _power(np.maximum(error, 1e-3 * sigma) * size, inverse, np.where(weight > 0, share, 0))
    return _measured(prior, inverse, line, power)


def _fit_likely(prior: Array, inverse: Array, share: Array, first: NDArray[np.bool_], seed: int) -> Alignment:
    """Fits as `fit_affine` to points (M,) some of which are hidden in the picture.

    Those of `first` (M,) are few and hardly ever hidden, but the nearest of their directions, where a map
    errs more than elsewhere. Their line decides which of all points the map shows; these give the affine.
    The residual is that of the first points: others were chosen by how well they fit.
    """
    found = fit_affine(prior[first], inverse[first], seed, share[first])
    for _ in range(LIKELY_ROUNDS):
        depth = np.maximum(found.scale * prior + found.offset, np.finfo(float).tiny)
        shown = np.abs(np.log(depth / inverse)) < NEAR
        if shown.sum() < first.sum() / 2:  # the first line is no alignment, as its residual will say
            break
        found = fit_affine(prior[shown], inverse[shown], seed, share[shown])
    return _measured(prior[first], inverse[first], (found.scale, found.offset), 0.0)


def likely_visible(panorama: Panorama, points: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Rows (M,) of points (P, 3) that a panorama is likely to see, and which of them it sees almost surely.

    A point is likely to be hidden if there is a much nearer one in about the same direction. Of more than
    `MOST_POINTS` points some are taken, evenly.
    """
    some = np.arange(0, len(points), max(1, -(-len(points) // MOST_POINTS)))
    columns = int(np.clip(math.sqrt(len(some) / 2), *COARSE))
    fine = _not_hidden(panorama, points[some], FINE * columns, BEHIND_FINE)
    coarse = _not_hidden(panorama, points[some], columns, BEHIND_COARSE)
    return some[fine | coarse], coarse[fine | coarse]


def _not_hidden(panorama: Panorama, points: Array, columns: int, behind: float) -> NDArray[np.bool_]:
    """(P,) whether a point is at most `behind` times as far as the nearest in its cell of a grid."""
    distance, v, u = project_to_pixels(panorama, points, columns, columns // 2)
    cell = v * columns + u
    nearest = np.full(columns * (columns // 2), np.inf)
    np.minimum.at(nearest, cell, np.where(distance > 0, distance, np.inf))
    return np.asarray(distance <= behind * nearest[cell])


def _measured(prior: Array, inverse: Array, line: tuple[float, float], power: float) -> Alignment:
    """A line with its residual; errors grow with inverse ** power."""
    error, sigma = _errors(prior, inverse, line, np.abs(inverse) ** power)
    inliers = int(np.count_nonzero(error < TUKEY * sigma))
    spread = float(np.median(np.abs(inverse - np.median(inverse))))
    residual = float(np.median(np.abs(inverse - (line[0] * prior + line[1]))))
    return Alignment(*line, residual / max(spread, np.finfo(float).tiny), inliers, len(prior))


def _errors(prior: Array, inverse: Array, line: tuple[float, float], size: Array) -> tuple[Array, float]:
    """Absolute residuals (M,) of a line in units of size (M,), and their robust standard deviation."""
    error = np.abs(inverse - (line[0] * prior + line[1])) / size
    return error, max(MAD_TO_SIGMA * float(np.median(error)), 1e-9 * float((np.abs(inverse) / size).max()))


def _power(error: Array, inverse: Array, share: Array) -> float:
    """k in [0, 1] of errors (M,) that grow with inverse ** k: a line through their logarithms (Harvey 1976).

    0 is a constant error, 1 a share of the inverse depth. Where some inverse is not positive it is 0.
    """
    if not (inverse > 0).all():
        return 0.0
    _, variance, _, covariance = _moments(np.log(inverse), np.log(error), share)
    return min(max(covariance / variance, 0.0), 1.0) if variance > 0 else 0.0


def _least_median(prior: Array, inverse: Array, random: np.random.Generator) -> tuple[float, float]:
    """The line through a random pair with the least median absolute residual (Rousseeuw 1984)."""
    first, second = random.integers(0, len(prior), (2, PAIRS))
    run = prior[second] - prior[first]
    usable = np.abs(run) > 1e-3 * float(np.ptp(prior))
    if not usable.any():
        raise AlignmentError("its values are the same at all sparse points")
    first, second, run = first[usable], second[usable], run[usable]
    slope = (inverse[second] - inverse[first]) / run
    offset = inverse[first] - slope * prior[first]
    trial = random.permutation(len(prior))[:TRIAL_POINTS]
    error = np.median(np.abs(inverse[trial] - (slope[:, None] * prior[trial] + offset[:, None])), axis=1)
    best = int(np.argmin(error))
    return float(slope[best]), float(offset[best])


def _weighted_line(x: Array, y: Array, weight: Array) -> tuple[float, float]:
    """Slope and offset of the reduced major axis of points (M,), (M,) with weights (M,).

    Least squares would blame y for all errors, and find too small a slope where x has some too
    (Kermack and Haldane 1950).
    """
    (x_mean, y_mean), x_variance, y_variance, covariance = _moments(x, y, weight)
    if not x_variance > 0:
        raise AlignmentError("its values are the same at all sparse points")
    slope = math.copysign(math.sqrt(y_variance / x_variance), covariance)
    return slope, y_mean - slope * x_mean


def _moments(x: Array, y: Array, weight: Array) -> tuple[tuple[float, float], float, float, float]:
    """Means of x and y (M,) with weights (M,), their variances and their covariance."""
    weight = weight / weight.sum()
    means = float((weight * x).sum()), float((weight * y).sum())
    x, y = x - means[0], y - means[1]
    return means, float((weight * x * x).sum()), float((weight * y * y).sum()), float((weight * x * y).sum())


def even_shares(v: NDArray[np.int64], u: NDArray[np.int64], height: int, width: int) -> Array:
    """Weights (M,) of points in rows v and columns u (M,) of a panorama; in each cell their sum is 1.

    The cells have equal solid angles. The errors of a map are correlated over some degrees, so a hundred
    points in one place say little more than one; without this the best textured wall would decide.
    """
    down = np.sin(((v + 0.5) / height - 0.5) * math.pi) / 2 + 0.5  # in (0, 1), uniform over the sphere
    cell = (BANDS * down).astype(np.int64) * (2 * BANDS) + u * (2 * BANDS) // width
    shares: Array = 1 / np.bincount(cell)[cell]
    return shares


def inverse_prior(raw: Tensor, kind: Literal["inverse", "depth"]) -> Tensor:
    """The prior (H, W) as inverse depth up to an affine; `kind` is "inverse" or "depth". 0 stays 0: sky."""
    return raw if kind == "inverse" else torch.where(raw > 0, 1 / raw, 0)


def align_depth(
    scene: Scene, view: View, seed: int, *, kind: Literal["inverse", "depth"] = "inverse"
) -> Alignment:
    """Aligns one panorama's prior to the sparse points that it observes (eq. 4).

    Where no panorama of the scene has observed any, as other programs write scenes, to those that it is
    likely to see.

    An affine that comes with the scene is taken where it fits the points as well as ours (`AS_GOOD`,
    `SLACK`), or where there are too few points for a fit. Points on sky or masked pixels do not count: on
    the sky mask where there is one, without it where the prior is 0.

    Args:
        view: the decoded panorama; its image is not used.
        kind: "inverse" or "depth": what the depth image holds.

    Raises AlignmentError: there are too few points or the result is implausible; the message is the reason;
    ValueError: the view has no depth image.
    """
    panorama = scene.panoramas[view.row]
    if view.inverse_depth is None:
        raise ValueError(f"{panorama.name} has no depth image")
    tracked = any(len(one.observed) for one in scene.panoramas)
    rows, first = panorama.observed, np.ones(len(panorama.observed), bool)
    if not tracked:
        rows, first = likely_visible(panorama, scene.points)
    prior, inverse, share, usable = _at_points(scene.points[rows], panorama, view, kind)
    first = first[usable]
    given = _usable(panorama.depth_affine)
    if len(prior) < MIN_POINTS:
        if given is None:
            raise AlignmentError(f"only {len(prior)} sparse points on it, {MIN_POINTS} are needed")
        found = Alignment(*given, residual=None)
        if len(prior) >= FEWEST:
            found = _measured(prior, inverse, given, 0.0)
        return _plausible(replace(found, given=True))
    if tracked or first.sum() < MIN_POINTS:
        fitted = fit_affine(prior, inverse, seed, share)
    else:
        fitted = _fit_likely(prior, inverse, share, first, seed)
        prior, inverse = prior[first], inverse[first]
    if panorama.depth_affine is not None:
        fitted = _better(panorama.depth_affine, prior, inverse, fitted)
    return _plausible(fitted)


def _at_points(
    points: Array, panorama: Panorama, view: View, kind: Literal["inverse", "depth"]
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """The map (M,) of a view at points (P, 3), their inverse distances and shares, and which (P,) they are.

    Points on sky, on masked pixels or on holes of the map are left out.
    """
    assert view.inverse_depth is not None
    height, width = view.inverse_depth.shape
    distance, v, u = project_to_pixels(panorama, points, width, height)
    prior = pixels(inverse_prior(view.inverse_depth, kind), v, u).astype(np.float64)
    usable = (prior > 0) & (distance > 0)
    if view.sky is not None:
        usable &= ~pixels(view.sky, v, u)
    if view.mask is not None:
        usable &= pixels(view.mask, v, u)
    return prior[usable], 1 / distance[usable], even_shares(v[usable], u[usable], height, width), usable


def _usable(affine: tuple[float, float] | None) -> tuple[float, float] | None:
    """The affine of a scene, unless it is one that a tool writes where its fit failed."""
    sound = affine is not None and all(map(math.isfinite, affine)) and affine[0] > 0
    return affine if sound else None


def _better(affine: tuple[float, float], prior: Array, inverse: Array, fitted: Alignment) -> Alignment:
    """The affine of the scene if it fits points (M,) as well as the fitted one, else that one with a note."""
    given, ours = _usable(affine), fitted.residual or 0.0
    if given is None:
        return replace(fitted, note=f"its affine {affine[0]:g}, {affine[1]:g} is no alignment: fitted again")
    found = _measured(prior, inverse, given, 0.0)
    if found.residual is not None and found.residual <= AS_GOOD * ours + SLACK:
        return replace(found, given=True)
    note = (
        f"its affine {affine[0]:g}, {affine[1]:g} has the residual {found.residual:.3g} at the sparse points,"
        f" the fit {ours:.3g}: fitted again"
    )
    return replace(fitted, note=note)


def _plausible(found: Alignment) -> Alignment:
    """The alignment itself. Raises AlignmentError if it cannot be right."""
    if not (math.isfinite(found.scale) and math.isfinite(found.offset)):
        raise AlignmentError(f"its affine {found.scale} · prior + {found.offset} is not finite")
    if found.residual is not None and not found.residual <= MAX_RESIDUAL:
        raise AlignmentError(
            f"its residual is {found.residual:.2f} of the points' spread, above {MAX_RESIDUAL:.2f}"
        )
    if not found.scale > 0:
        raise AlignmentError(f"its scale is {found.scale:.3g}, which is not positive")
    return found
