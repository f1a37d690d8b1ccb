"""The similarity from an SfM result to GPS: robust, and with a test whether GPS is sufficient.

Heights of GPS are two to three times worse than its positions, and a straight walk leaves the turn about its
own axis open. So up comes from the cameras where they have one; GPS gives the rest: turn about up, scale,
east and north from the positions, and one shift from the heights.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.world.exif import GpsFix
from panolog.prepare.world.similarity import Similarity
from panolog.scene.write import Origin

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

ACCURACY = 5.0  # metres: 4.9 m is usual of phones under open sky (GPS.gov; van Diggelen and Enge, ION 2015)
MIN_FIXES = 4  # at different places: three have six coordinates for four unknowns, too few to see an outlier
MIN_SPREAD = 5.0  # times the noise: scale and turn are then known to a fifth, or better
_OUTLIER = 2.5  # times the accuracy: from there on a fix is wrong
_TAIL = 4.0  # times the median error, if GPS is better than stated: one good fix in 40,000 is further off
_HEIGHTS = 2.0  # times as far off as positions may be: heights are that much worse
_DRIFT = 0.02  # of the spread: so much SfM bends over its length, which is no fault of GPS
_FLOOR = 0.5  # of the accuracy: smaller residuals are no proof, as errors of fixes near each other are alike
_PAIRS = 1_000  # hypotheses; with half of the fixes wrong, one in four is right
_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class GpsFixes:
    """GPS as positions. Cameras with the same fix count as one place, in the middle of them."""

    origin: Origin
    members: tuple[NDArray[np.int64], ...]  # F of (M,): rows of the cameras with that fix
    enu: Array  # (F, 3) metres east, north, up of the origin; up is NaN without an altitude

    @property
    def cameras(self) -> int:
        """How many cameras have a fix."""
        return sum(map(len, self.members))

    def places(self, centers: Array) -> Array:
        """(F, 3) the mean position of the cameras of each fix, of centers (K, 3)."""
        return np.stack([centers[rows].mean(axis=0) for rows in self.members])


@dataclass(frozen=True, eq=False)
class GpsFit:
    """A similarity from the SfM world to east, north, up, and how well it fits."""

    fixes: GpsFixes
    similarity: Similarity
    inliers: NDArray[np.bool_]  # (F,) fixes that it follows
    spread: float  # metres, rms distance of these fixes from their middle
    residual: float  # metres, rms horizontal distance of these fixes, for each degree of freedom
    vertical: float | None  # metres, median height difference; None without altitudes

    @property
    def is_sufficient(self) -> bool:
        """Whether the fixes are sufficient: most agree, and they are apart by several times their noise."""
        enough = self.inliers.sum() >= max(MIN_FIXES, len(self.inliers) / 2)
        return bool(enough and self.uncertainty <= 1 / MIN_SPREAD)

    @property
    def uncertainty(self) -> float:
        """The relative error of the scale, and the error of the turn in radians.

        It does not fall with the number of fixes: errors of GPS last for minutes, so many fixes share them.
        """
        noise = max(self.residual, _FLOOR * ACCURACY)
        return noise / self.spread if self.spread > 0 else float("inf")


def collect_fixes(fixes: Sequence[GpsFix | None]) -> GpsFixes | None:
    """The fixes of K cameras as positions around the median one; None if there are none."""
    rows: dict[tuple[float, float], list[int]] = {}
    for row, fix in enumerate(fixes):
        if fix is not None:
            rows.setdefault((fix.latitude, fix.longitude), []).append(row)
    if not rows:
        return None
    altitudes = np.array([_altitude([fixes[row] for row in members]) for members in rows.values()])
    level = float(np.nanmedian(altitudes)) if np.isfinite(altitudes).any() else 0.0
    places = np.array([(latitude, longitude, level) for latitude, longitude in rows])
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    ecef = np.asarray(transform.ellipsoid_to_ecef(places))
    middle = places[np.argmin(np.linalg.norm(ecef - np.median(ecef, axis=0), axis=1))].copy()
    places[:, 2] = np.where(np.isfinite(altitudes), altitudes, level)
    enu = np.array(transform.ellipsoid_to_enu(places, *middle))
    enu[~np.isfinite(altitudes), 2] = np.nan
    origin = Origin(latitude=float(middle[0]), longitude=float(middle[1]), altitude=level)
    return GpsFixes(origin, tuple(np.array(members, np.int64) for members in rows.values()), enu)


def east_north_up(fixes: Sequence[GpsFix], origin: Origin) -> Array:
    """(F, 3) metres east, north and up of an origin; a fix without an altitude is level with it."""
    places = [
        (fix.latitude, fix.longitude, origin.altitude if fix.altitude is None else fix.altitude)
        for fix in fixes
    ]
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    where = origin.latitude, origin.longitude, origin.altitude
    return np.array(transform.ellipsoid_to_enu(np.array(places).reshape(-1, 3), *where))


def _altitude(fixes: Sequence[GpsFix | None]) -> float:
    """The median altitude of fixes at one place, in metres; NaN if none has one."""
    known = [fix.altitude for fix in fixes if fix is not None and fix.altitude is not None]
    return float(np.median(known)) if known else np.nan


def fit_upright(fixes: GpsFixes, centers: Array, scale: float | None) -> GpsFit | None:
    """Turn about z, scale and shift from the cameras' places, whose z is up, to those of their fixes.

    RANSAC over pairs, then iteratively reweighted least squares with the weights of Geman and McClure.

    Args:
        fixes: their altitudes may be missing.
        centers: (K, 3) the cameras' positions.
        scale: metres per unit of `centers`, if it is known.

    Returns:
        None if there are fewer than two different places.
    """
    places, enu = fixes.places(centers), fixes.enu
    source, target = places[:, 0] + 1j * places[:, 1], enu[:, 0] + 1j * enu[:, 1]
    limit = _limit(enu)
    found = _best_pair(source, target, limit, scale)
    if found is None:
        return None
    turn, shift, inliers = _refined(source, target, *found, limit, scale)
    factor, angle = float(np.abs(turn)), float(np.angle(turn))
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    known = inliers & np.isfinite(enu[:, 2])
    lift = float(np.median((enu[:, 2] - factor * places[:, 2])[known])) if known.any() else None
    up = -factor * float(np.median(places[:, 2])) if lift is None else lift
    similarity = Similarity(factor, rotation, np.array([shift.real, shift.imag, up]))
    return _measured(fixes, centers, similarity, inliers, scale)


def fit_free(fixes: GpsFixes, centers: Array, scale: float | None) -> GpsFit | None:
    """Fits the scene to fixes, up included; None if there is no similarity, or it may tip.

    For scenes without a common up: all fixes need an altitude, and must lie far enough from any straight line
    that the heights cannot turn the scene about it.
    """
    places, enu = fixes.places(centers), fixes.enu
    limit = _HEIGHTS * _limit(enu)
    options = pycolmap.RANSACOptions(max_error=limit, random_seed=0)
    found: Any  # a dictionary, unlike its declared type
    if scale is None:
        found = pycolmap.estimate_sim3d_robust(places, enu, options)
    else:
        found = pycolmap.estimate_rigid3d_robust(scale * places, enu, options)
    if found is None:
        return None
    moved, inliers = found["tgt_from_src"], np.array(found["inlier_mask"], np.bool_)
    factor = float(moved.scale) if scale is None else scale
    if not (factor > 0 and inliers.any()):
        return None
    similarity = Similarity(factor, np.array(moved.rotation.matrix()), np.array(moved.translation))
    fit = _measured(fixes, centers, similarity, inliers, scale)
    noise = max(fit.residual, fit.vertical or 0.0, _FLOOR * ACCURACY)
    return fit if _width(enu[inliers]) >= MIN_SPREAD * noise else None


def _width(points: Array) -> float:
    """The rms distance of points (N, 3) from the straight line that fits them best."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.linalg.norm(values[1:]) / np.sqrt(len(points)))


def _limit(enu: Array) -> float:
    """Metres from which on a fix is an outlier."""
    apart = np.linalg.norm(enu[:, :2] - np.median(enu[:, :2], axis=0), axis=1)
    return max(_OUTLIER * ACCURACY, _DRIFT * float(np.median(apart)))


def _best_pair(
    source: Complex, target: Complex, limit: float, scale: float | None
) -> tuple[complex, complex] | None:
    """(turn, shift) with target ≈ turn · source + shift, of that pair of fixes which most agree with.

    The cost of each is its squared residual up to `limit` (MSAC, Torr and Zisserman 2000).
    """
    best, least = None, np.inf
    for a, b in _pairs(len(source)):
        step, wanted = source[b] - source[a], target[b] - target[a]
        if abs(step) < 1e-12 * np.abs(source).max() or abs(wanted) == 0:
            continue
        turn = complex(wanted / step)
        if scale is not None:
            turn *= scale / abs(turn)
        shift = complex((target[a] + target[b] - turn * (source[a] + source[b])) / 2)
        cost = float((np.minimum(np.abs(turn * source + shift - target), limit) ** 2).sum())
        if cost < least:
            best, least = (turn, shift), cost
    return best


def _pairs(count: int) -> NDArray[np.int64]:
    """(P, 2) different rows below `count`: all pairs if there are few, else always the same random ones."""
    if count * (count - 1) // 2 <= _PAIRS:
        return np.stack(np.triu_indices(count, 1), axis=1)
    random = np.random.default_rng(0)
    first = random.integers(count, size=_PAIRS)
    return np.stack([first, (first + random.integers(1, count, size=_PAIRS)) % count], axis=1)


def _refined(
    source: Complex, target: Complex, turn: complex, shift: complex, limit: float, scale: float | None
) -> tuple[complex, complex, NDArray[np.bool_]]:
    """The similarity by all fixes, each the less the further it is off; and (F,) which are not wrong."""
    for _ in range(_ITERATIONS):
        errors, scatter = _errors(source, target, turn, shift, limit)
        weights = (errors <= limit) / (1 + (errors / (2 * scatter)) ** 2) ** 2
        total = weights.sum()
        if not total > 0:
            break
        origin, goal = weights @ source / total, weights @ target / total
        moment = weights @ (np.conj(source - origin) * (target - goal))
        size = weights @ np.abs(source - origin) ** 2
        if abs(moment) == 0 or not size > 0:
            break
        turn = complex(moment / size if scale is None else scale * moment / abs(moment))
        shift = complex(goal - turn * origin)
    errors, scatter = _errors(source, target, turn, shift, limit)
    return turn, shift, errors <= min(limit, _TAIL * scatter)


def _errors(
    source: Complex, target: Complex, turn: complex, shift: complex, limit: float
) -> tuple[Array, float]:
    """(F,) metres, and the median of those up to `limit`."""
    errors: Array = np.abs(turn * source + shift - target)
    near = errors[errors <= limit]
    return errors, max(float(np.median(near)), 1e-6 * limit) if len(near) else limit


def _measured(
    fixes: GpsFixes,
    centers: Array,
    similarity: Similarity,
    inliers: NDArray[np.bool_],
    scale: float | None,
) -> GpsFit:
    """The fit with its residuals; `freedom` unknowns were found from the horizontal positions."""
    followed = fixes.enu[inliers]
    off = similarity.points(fixes.places(centers))[inliers] - followed
    count = len(followed)
    left = max(2 * count - (4 if scale is None else 3), 1)
    residual = float(np.sqrt(2 * (off[:, :2] ** 2).sum() / left))
    middle = followed[:, :2].mean(axis=0) if count else np.zeros(2)
    spread = float(np.sqrt(((followed[:, :2] - middle) ** 2).sum(axis=1).mean())) if count else 0.0
    heights = np.abs(off[:, 2][np.isfinite(off[:, 2])])
    vertical = float(np.median(heights)) if len(heights) else None
    return GpsFit(fixes, similarity, inliers, spread, residual, vertical)
