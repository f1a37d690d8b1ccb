"""The ellipsoid WGS84: places by latitude, longitude and height, and by metres from the middle of the earth.

Constants: NGA.STND.0036, "Department of Defense World Geodetic System 1984". Formulas: the closed form of
geodetic to geocentric coordinates, and the local axes as its derivatives (B. Hofmann-Wellenhof et al., GPS:
Theory and Practice, 2001, ch. 10).
"""

import math

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_A = 6_378_137.0  # metres, the semi-major axis
_F = 1 / 298.257223563  # flattening
_E2 = _F * (2 - _F)  # first eccentricity squared


def geocentric(latitude: float, longitude: float, height: float) -> Doubles:
    """(3,) metres in the earth-centred, earth-fixed frame (EPSG:4978).

    Args: latitude and longitude in degrees, height in metres above the ellipsoid.
    Raises ValueError if there is no such place.
    """
    if not (-90 <= latitude <= 90 and math.isfinite(longitude) and math.isfinite(height)):
        raise ValueError(
            f"latitude {latitude}, longitude {longitude}, height {height} is nowhere on the earth"
        )
    phi, lam = math.radians(latitude), math.radians(longitude)
    normal = _A / math.sqrt(1 - _E2 * math.sin(phi) ** 2)
    across = (normal + height) * math.cos(phi)
    return np.array(
        [across * math.cos(lam), across * math.sin(lam), (normal * (1 - _E2) + height) * math.sin(phi)]
    )


def enu_to_ecef(latitude: float, longitude: float, height: float) -> Doubles:
    """(4, 4) from east, north and up in metres around a place to the earth-centred, earth-fixed frame.

    Args and what it raises as of `geocentric`. At the poles east is that of the longitude.
    """
    place = geocentric(latitude, longitude, height)
    phi, lam = math.radians(latitude), math.radians(longitude)
    east = [-math.sin(lam), math.cos(lam), 0.0]
    north = [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)]
    up = [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)]
    frame = np.eye(4)
    frame[:3] = np.stack([east, north, up, place], axis=1)
    return frame


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
