"""Measurements on the pictures: a common shift in pixels, patches of two views, the pose of each picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from panolog.prepare.check.evidence import (
    Array,
    Evidence,
    bilinear,
    color_agreement,
    correlation,
    median_or_zero,
    project,
)

PATCH = 7  # samples, each way, of a patch
_PAIRS = 400  # points whose patches are compared
_STEPS = 8  # of the estimate of a shift
_TUKEY = 4.0  # medians of the errors: points with larger ones are hidden, or moved, and have no weight
_POLE = 0.15  # fractions of the height at either pole where a column is too narrow to measure a shift
_SHUFFLE_POINTS = 300


@dataclass(frozen=True)
class PixelShift:
    """The offset of the pictures from the points in pixels, and one sigma."""

    u: float
    v: float
    sigma: float


def common_shift(evidence: Evidence) -> PixelShift | None:
    """The shift of all pictures that fits the points' colours best: Lucas-Kanade with robust weights.

    Positive where the picture of a point lies right of, or below, its projection. None if it cannot be
    measured.
    """
    scale = evidence.scene.width / evidence.pictures[0].shape[1]  # of panoramas that were shrunk
    greys = [_grey(picture) for picture in evidence.pictures]
    shift, sigma = np.zeros(2), float("inf")
    for _ in range(_STEPS):
        views = [_linearised(evidence, view, grey, shift) for view, grey in enumerate(greys)]
        errors = np.concatenate([error for _, error in views])
        if len(errors) < 50:
            return None
        bound = _TUKEY * float(np.median(np.abs(errors))) + 1e-9
        weights = [np.clip(1 - (error / bound) ** 2, 0, None)[:, None] ** 2 for _, error in views]
        weighted = [(slopes * w, slopes, error) for w, (slopes, error) in zip(weights, views, strict=True)]
        normal = sum((heavy.T @ slopes for heavy, slopes, _ in weighted), np.zeros((2, 2)))
        if np.linalg.cond(normal) > 1e8:
            return None
        pulls = np.array([heavy.T @ error for heavy, _, error in weighted])  # (V, 2) of each view
        shift = np.clip(shift + np.clip(np.linalg.solve(normal, pulls.sum(axis=0)), -0.7, 0.7), -4, 4)
        # Points of one view err together, as where something hides them: only views are independent.
        spread = np.linalg.inv(normal) @ (pulls - pulls.mean(axis=0)).T
        sigma = float(np.linalg.norm(spread, axis=1).max())
    if not np.isfinite(sigma):
        return None
    return PixelShift(float(shift[0] * scale), float(shift[1] * scale), sigma * scale)


def _linearised(
    evidence: Evidence, view: int, grey: NDArray[np.float32], shift: Array
) -> tuple[Array, Array]:
    """Slopes (N, 2) in grey levels per pixel and errors (N,) at the shifted projections of a view."""
    row = evidence.views[view]
    seen = evidence.seen[row]
    where = project(evidence.directions(row, evidence.scene.points[seen]))
    inside = np.abs(where[:, 1] - 0.25) < 0.25 - 0.5 * _POLE
    if inside.sum() < 20:
        return np.empty((0, 2)), np.empty(0)
    pixel = 1 / grey.shape[1]
    where, expected = where[inside] + shift * pixel, evidence.colors[seen[inside]].mean(axis=1)
    found = bilinear(grey, where)[:, 0]
    steps = np.array([(pixel, 0.0), (0.0, pixel)])
    slopes = [(bilinear(grey, where + step) - bilinear(grey, where - step))[:, 0] / 2 for step in steps]
    # Exposure and contrast of a view are its own.
    gain, offset = np.polyfit(found, expected, 1) if np.ptp(found) > 0 else (1.0, 0.0)
    return gain * np.stack(slopes, axis=1), expected - gain * found - offset


def _grey(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W, 1), smoothed so that a straight line fits it over a pixel."""
    grey = picture.mean(axis=2, dtype=np.float32)
    padded = np.concatenate([grey[:, -8:], grey, grey[:, :8]], axis=1)  # the seam is no edge
    smooth: NDArray[np.float32] = np.asarray(cv2.GaussianBlur(padded, (0, 0), 1.0), np.float32)
    return smooth[:, 8:-8, None]


def patch_agreement(evidence: Evidence) -> float:
    """Median correlation of patches of the same points in two views; 0 if no two views share points.

    A patch is a small square at the point, across the line of sight of the first view, seen by both.
    """
    random = np.random.default_rng(17)
    found = []
    for a, b in _pairs(evidence):
        shared = np.intersect1d(evidence.seen[evidence.views[a]], evidence.seen[evidence.views[b]])
        for point in random.permutation(shared)[: max(8, _PAIRS // len(evidence.views))]:
            found.append(_patches(evidence, a, b, int(point)))
    return median_or_zero(found)


def _pairs(evidence: Evidence) -> list[tuple[int, int]]:
    """Each view with the nearest other one."""
    centers = evidence.scene.centers[list(evidence.views)]
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return [(view, int(np.argmin(apart[view]))) for view in range(len(centers))]


def _patches(evidence: Evidence, a: int, b: int, point: int) -> float:
    rows = evidence.views[a], evidence.views[b]
    place = evidence.scene.points[point]
    sight = place - evidence.scene.centers[rows[0]]
    distance = float(np.linalg.norm(sight))
    across = np.linalg.svd(sight[None] / max(distance, 1e-12))[2][1:]  # (2, 3) unit vectors
    size = distance * 2 * np.pi / evidence.pictures[a].shape[1] * 1.5
    grid = (np.stack(np.meshgrid(*[np.arange(PATCH) - PATCH // 2] * 2), axis=-1) * size).reshape(-1, 2)
    square = place + grid @ across
    values = []
    for view, row in zip((a, b), rows, strict=True):
        where = project(evidence.directions(row, square))
        values.append(bilinear(evidence.pictures[view], where))
    return correlation(values[0], values[1])


def fits_of_poses(evidence: Evidence) -> Array:
    """(V, V) how well picture i fits the pose of view j: on the diagonal, its own."""
    fits = np.zeros((len(evidence.views), len(evidence.views)))
    for j, row in enumerate(evidence.views):
        seen = evidence.seen[row][:: max(1, len(evidence.seen[row]) // _SHUFFLE_POINTS)]
        directions = evidence.directions(row, evidence.scene.points[seen])
        for i in range(len(evidence.views)):
            fits[i, j] = color_agreement(evidence, i, directions, seen)
    return fits
