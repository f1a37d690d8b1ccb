"""The frame of a scene: z up by gravity, metres east, north and up by GPS where that is sufficient.

An SfM result is known up to a similarity. Here one is found: the world then has its origin among the cameras,
so that coordinates stay small, and where on the earth that is goes into SCENE/offset.json.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.world.exif import Attitude, GpsFix
from panolog.prepare.world.gps import (
    ACCURACY,
    MIN_FIXES,
    GpsFit,
    GpsFixes,
    collect_fixes,
    fit_free,
    fit_upright,
)
from panolog.prepare.world.gravity import UpDirection, find_north, find_up, leveling
from panolog.prepare.world.similarity import Similarity
from panolog.scene.errors import ConfigError

Array = NDArray[np.float64]

MAX_SPREAD = 30.0  # degrees: carried cameras differ by 5 to 15, those tilted at random by 70 and more


@dataclass(frozen=True, eq=False)
class Georeference:
    """The frame of a scene, and how it was found."""

    similarity: Similarity  # from the SfM result's world to the scene's
    frame: Literal["arbitrary", "upright", "enu"]  # upright = z up; enu = x east, y north, z up as well
    metric: bool  # units are metres
    up: UpDirection  # as the SfM result has it
    gps: GpsFit | None  # of the frame enu; from the SfM result with its base levelled
    notes: tuple[str, ...]  # one line each: what was not used, and why


def georeference(
    rotations: Array,
    centers: Array,
    attitudes: Sequence[Attitude | None],
    fixes: Sequence[GpsFix | None],
    *,
    scale: float | None = None,
) -> Georeference:
    """Finds the frame of an SfM result of K cameras; the same input gives the same result.

    Args:
        rotations: (K, 3, 3) world-to-camera, x right, y down, z forward.
        centers: (K, 3) the cameras' positions.
        scale: metres per unit, if it is known; it then takes precedence over GPS.
    """
    up, up_notes = find_up(rotations, attitudes)
    notes = list(up_notes)
    level = up.spread <= MAX_SPREAD
    if not level:
        notes.append(f"the cameras' ups differ by {up.spread:.0f} degrees: not levelled by them")
    base = leveling(up.direction) if level else np.eye(3)
    fit, why = _fit(collect_fixes(fixes), centers @ base.T, level, scale)
    notes.extend(why)
    if fit is not None:
        moved = fit.similarity
        whole = Similarity(moved.scale, moved.rotation @ base, moved.translation)
        return Georeference(whole, "enu", True, up, fit, tuple(notes))
    if level and (north := find_north(rotations @ base.T, attitudes)) is not None:
        turn, spread, count = north
        base = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix() @ base
        notes.append(f"y is north by the headings in {count} files, which differ by {spread:.1f} degrees")
    factor = 1.0 if scale is None else scale
    centered = Similarity(factor, base, -factor * base @ centers.mean(axis=0))
    return Georeference(
        centered, "upright" if level else "arbitrary", scale is not None, up, None, tuple(notes)
    )


def scale_from_distance(
    names: Sequence[str], centers: Array, first: str, second: str, metres: float
) -> float:
    """Metres per unit, from the distance between the cameras of two panoramas.

    Args:
        centers: (K, 3) their positions.
        metres: between them.

    Raises ConfigError: a panorama is not among them, or they are at one place.
    """
    for name in (first, second):
        if name not in names:
            raise ConfigError(f"--distance: {name} has no pose, as {len(names)} have; name two of those")
    apart = float(np.linalg.norm(centers[names.index(first)] - centers[names.index(second)]))
    if apart <= 1e-9 * float(np.linalg.norm(np.ptp(centers, axis=0))) or apart == 0:
        raise ConfigError(
            f"--distance: {first} and {second} are at the same place; name two that are far apart"
        )
    return metres / apart


def _fit(
    fixed: GpsFixes | None, centers: Array, level: bool, scale: float | None
) -> tuple[GpsFit | None, tuple[str, ...]]:
    """The fit of centers (K, 3) to GPS, and notes on why GPS is not used or not in full."""
    if fixed is None:
        return None, ()
    who = f"GPS of {fixed.cameras} panoramas"
    places = len(fixed.members)
    spread = float(np.linalg.norm(np.std(fixed.enu[:, :2], axis=0)))
    if places < MIN_FIXES:
        return None, (
            f"{who} spreads over {spread:.1f} m at {places} different places, fewer than {MIN_FIXES}: "
            "not used",
        )
    if level:
        fit = fit_upright(fixed, centers, scale)
    else:
        known = np.isfinite(fixed.enu).all()
        fit = fit_free(fixed, centers, scale) if known else None
        if fit is None:
            return None, (
                f"{who} does not determine which way is up (a straight line, or no altitudes): not used",
            )
    if fit is None:
        return None, (f"{who}: the cameras are all at one place: not used",)
    wrong = places - int(fit.inliers.sum())
    if not fit.is_sufficient:
        found = f"{who} spreads over {fit.spread:.1f} m with residual {fit.residual:.1f} m"
        misfits = f"{wrong} of {places} places do not fit, accuracy {ACCURACY:g} m"
        return None, (f"{found} ({misfits}): not used",)
    return fit, (f"{who}: {wrong} of {places} places do not fit and are left out",) if wrong else ()
