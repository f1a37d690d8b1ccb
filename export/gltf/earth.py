"""The frame of a place on the earth: WGS84, in float64.

Formulas: the closed form of geodetic to geocentric coordinates, and the local axes as derivatives of it
(B. Hofmann-Wellenhof et al., GPS: Theory and Practice, 2001, ch. 10).
"""

import math

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_MAJOR = 6_378_137.0  # metres: WGS84's equatorial radius
_FLATTENING = 1 / 298.257223563
_SQUARE = _FLATTENING * (2 - _FLATTENING)  # of the eccentricity


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
    normal = _MAJOR / math.sqrt(1 - _SQUARE * math.sin(phi) ** 2)
    across = (normal + height) * math.cos(phi)
    return np.array(
        [across * math.cos(lam), across * math.sin(lam), (normal * (1 - _SQUARE) + height) * math.sin(phi)]
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
