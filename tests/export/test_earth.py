"""Places on WGS84."""

import math

import numpy as np
import pytest

from panolog.export.earth import enu_to_ecef, geocentric, geodetic_of

PLACES = [
    (0, 0, 0),
    (48.137, 11.575, 520),
    (-33.86, 151.21, -20),
    (89.9999, -170, 3000),
    (12.3, 179.9999, 8848),
]


def test_known_places() -> None:
    """By hand: the semi-axes of WGS84 are 6378137 and 6356752.3142 m."""
    np.testing.assert_allclose(geocentric(0, 0, 10), [6378147, 0, 0], atol=1e-6)
    np.testing.assert_allclose(geocentric(0, 90, 0), [0, 6378137, 0], atol=1e-6)
    np.testing.assert_allclose(geocentric(90, 0, 0), [0, 0, 6356752.3142], atol=1e-4)
    np.testing.assert_allclose(geocentric(-90, 0, 100), [0, 0, -6356852.3142], atol=1e-4)
    munich = [4177999.8221, 855720.5572, 4727443.0906]  # by PROJ
    np.testing.assert_allclose(geocentric(48.137, 11.575, 520), munich, atol=1e-3)


@pytest.mark.parametrize("place", PLACES)
def test_axes_point_where_coordinates_grow_and_places_lead_back(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    frame, step = enu_to_ecef(*place), 1e-4
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-14)
    up = geocentric(latitude, longitude, height + 1) - geocentric(latitude, longitude, height)
    np.testing.assert_allclose(up, frame[:3, 2], atol=1e-8)
    east = geocentric(latitude, longitude + step, height) - geocentric(latitude, longitude - step, height)
    np.testing.assert_allclose(east / np.linalg.norm(east), frame[:3, 0], atol=1e-5)
    south = geocentric(latitude - step, longitude, height) - geocentric(latitude, longitude, height)
    np.testing.assert_allclose(south / np.linalg.norm(south), -frame[:3, 1], atol=1e-5)
    np.testing.assert_allclose(frame[:3, 3], geocentric(*place))
    np.testing.assert_allclose(geodetic_of(geocentric(*place)), place, atol=1e-6)


@pytest.mark.parametrize("place", [(91, 0, 0), (0, math.nan, 0), (0, 0, math.inf), (math.nan, 0, 0)])
def test_nowhere(place: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="nowhere on the earth"):
        enu_to_ecef(*place)
