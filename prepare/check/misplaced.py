"""Single panoramas that are not where their poses say, among others that are.

By tracks, the points of such a panorama are far from where it has observed them. By colours, also without
tracks, its picture fits the points no better than if it were turned at random, while the others' fit. Where
neither can be measured, only a camera far away from all others is found.
"""

from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from panolog.partition.bounds import strays
from panolog.prepare.check.conventions import FIT
from panolog.prepare.check.evidence import (
    POINTS,
    Array,
    bilinear,
    correlation,
    in_threads,
    is_colorless,
    likely_seen,
    project,
    read_tracks,
)
from panolog.prepare.check.residuals import FEWEST, measure_residuals
from panolog.scene.errors import SceneError
from panolog.scene.image_files import decode_with_alpha
from panolog.scene.model import Scene

_FEWEST_PANORAMAS = 3
_WIDTH = 512  # pixels of the panoramas as their colours are compared
_OFF, _TIMES = 3.0, 10.0  # pixels, and medians over the panoramas: more is no error of the measurement
_SHARE = 0.5  # of the median correlation over the panoramas, below which a picture may be elsewhere
_TURNED, _BETTER = 24, 0.15  # random turns, and by how much a picture at its place fits better than in any
_NAMED = 20  # panoramas that get a line each


def find_misplaced(scene: Scene) -> dict[str, str]:
    """What is wrong with single panoramas, by name, in the scene's order.

    A panorama that cannot be decoded counts as one that fits. Raises SceneError if the model is damaged.
    """
    if len(scene.panoramas) < _FEWEST_PANORAMAS:
        return {}
    tracks = read_tracks(scene)
    apart = np.full(len(scene.panoramas), np.nan) if tracks is None else measure_residuals(scene, tracks)
    fits = _color_fits(scene)
    stray = strays(scene.centers)
    found = {}
    for row, panorama in enumerate(scene.panoramas):
        if np.isfinite(apart[row]) and apart[row] > max(_OFF, _TIMES * float(np.nanmedian(apart))):
            found[panorama.name] = f"its points are {apart[row]:.0f} px from where it has observed them"
        elif _fits_nowhere(fits[row], fits[:, 0]):
            others = np.nanmedian(fits[:, 0])
            found[panorama.name] = (
                f"its colours and the points' correlate by {fits[row, 0]:.2f}, others' by {others:.2f}"
            )
        elif stray[row] and np.isnan(apart[row]) and np.isnan(fits[row, 0]):
            found[panorama.name] = "its camera is farther from all others than they are from each other"
    return found


def misplaced_lines(found: dict[str, str]) -> list[str]:
    """A line for each panorama, and one for those beyond `_NAMED`."""
    lines = [f"pose: {name} is not where its pose says: {why}" for name, why in found.items()]
    if len(lines) <= _NAMED:
        return lines
    return [*lines[:_NAMED], f"pose: {len(lines) - _NAMED} more are not: {', '.join(list(found)[_NAMED:])}"]


def _fits_nowhere(fit: Array, every: Array) -> bool:
    """Args: fit, own and turned correlations as `_color_fit`; every (K,), the panoramas' own."""
    own, turned = fit
    if np.isnan(own):
        return False
    usual = float(np.nanmedian(every))
    return usual >= FIT and own < _SHARE * usual and own < turned + _BETTER


def _color_fits(scene: Scene) -> Array:
    """(K, 2) of `_color_fit`; NaN where it is not known."""
    every = np.full((len(scene.panoramas), 2), np.nan)
    if is_colorless(scene.colors):
        return every
    turns = Rotation.random(_TURNED, random_state=1).as_matrix()
    every[:] = list(in_threads(partial(_color_fit, scene, turns), range(len(every))))
    return every


def _color_fit(scene: Scene, turns: Array, row: int) -> tuple[float, float]:
    """How well a picture fits the colours of the points that it sees: as posed, and at best turned.

    Args: turns (N, 3, 3) of the camera. NaN where it sees few, or shows nothing.
    """
    panorama = scene.panoramas[row]
    seen = panorama.observed
    if len(seen) < FEWEST:
        seen = likely_seen(scene.points, panorama.center)
    seen = seen[:: max(1, len(seen) // POINTS)]
    try:
        picture, used = decode_with_alpha(scene.panoramas[row].image, min(_WIDTH, scene.width), quick=True)
    except SceneError:
        return np.nan, np.nan
    if len(seen) < FEWEST or not picture.std() > 0 or (used is not None and not used.any()):
        return np.nan, np.nan
    directions = scene.points[seen] @ panorama.rotation.T + panorama.translation
    fits = [
        correlation(bilinear(picture, project(it)), scene.colors[seen].astype(np.float64))
        for it in (directions, *(directions @ turn for turn in turns))
    ]
    return fits[0], max(fits[1:])
