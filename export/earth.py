"""The ellipsoid WGS84: places by latitude, longitude and height, and by metres from the middle of the earth.

Constants and formulas: NGA.STND.0036, "Department of Defense World Geodetic System 1984".
"""

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_A = 6_378_137.0  # metres, the semi-major axis
_F = 1 / 298.257223563  # flattening
_E2 = _F * (2 - _F)  # first eccentricity squared


def local_to_ecef(latitude: float, longitude: float, height: float) -> Doubles:
    """(4, 4) from metres east, north and up of a place to metres from the middle of the earth (ECEF).

    Args: degrees, degrees, metres above the ellipsoid.
    """
    phi, lam = np.radians([latitude, longitude])
    sin_phi, cos_phi, sin_lam, cos_lam = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    normal = _A / np.sqrt(1 - _E2 * sin_phi**2)
    matrix = np.eye(4)
    matrix[:3, 0] = -sin_lam, cos_lam, 0
    matrix[:3, 1] = -sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi
    matrix[:3, 2] = cos_phi * cos_lam, cos_phi * sin_lam, sin_phi
    matrix[:3, 3] = matrix[:3, 2] * (normal + height)
    matrix[2, 3] = (normal * (1 - _E2) + height) * sin_phi
    return matrix


def geodetic_of(place: Doubles) -> tuple[float, float, float]:
    """(latitude, longitude, height) in degrees and metres of a place (3,) in ECEF, nearer than the moon.

    By iteration of the latitude (Bowring), to less than a millimetre.
    """
    x, y, z = place
    across = np.hypot(x, y)
    beta = np.arctan2(z, (1 - _F) * across)
    phi = beta
    for _ in range(5):
        b = _A * (1 - _F)
        rise = z + _E2 / (1 - _E2) * b * np.sin(beta) ** 3
        phi = np.arctan2(rise, across - _E2 * _A * np.cos(beta) ** 3)
        beta = np.arctan2((1 - _F) * np.sin(phi), np.cos(phi))
    normal = _A / np.sqrt(1 - _E2 * np.sin(phi) ** 2)
    height = across * np.cos(phi) + z * np.sin(phi) - normal * (1 - _E2 * np.sin(phi) ** 2)
    return float(np.degrees(phi)), float(np.degrees(np.arctan2(y, x))), float(height)
