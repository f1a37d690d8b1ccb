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
def test_on_the_ellipsoid_with_its_normal(place: tuple[float, float, float]) -> None:
    """The foot of a place fulfils the ellipsoid's equation, whose gradient is the direction up."""
    latitude, longitude, height = place
    foot, frame = geocentric(latitude, longitude, 0), enu_to_ecef(*place)
    axes = np.array([6378137.0, 6378137.0, 6356752.314245179])
    assert np.sum((foot / axes) ** 2) == pytest.approx(1, abs=1e-13)
    gradient = foot / axes**2
    np.testing.assert_allclose(frame[:3, 2], gradient / np.linalg.norm(gradient), atol=1e-12)
    np.testing.assert_allclose(frame[:3, 3] - foot, height * frame[:3, 2], atol=1e-8)


@pytest.mark.parametrize("place", PLACES)
def test_east_and_north_are_where_coordinates_grow(place: tuple[float, float, float]) -> None:
    latitude, longitude, height = place
    frame, step = enu_to_ecef(*place), 1e-4
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-14)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
    east = geocentric(latitude, longitude + step, height) - geocentric(latitude, longitude - step, height)
    np.testing.assert_allclose(east / np.linalg.norm(east), frame[:3, 0], atol=1e-5)
    north = geocentric(latitude + step / 4, longitude, height) - geocentric(
        latitude - step, longitude, height
    )
    np.testing.assert_allclose(north / np.linalg.norm(north), frame[:3, 1], atol=1e-5)


@pytest.mark.parametrize("place", PLACES)
def test_it_leads_back(place: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(geodetic_of(geocentric(*place)), place, atol=1e-6)


@pytest.mark.parametrize("place", [(91, 0, 0), (0, math.nan, 0), (0, 0, math.inf), (math.nan, 0, 0)])
def test_nowhere(place: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="nowhere on the earth"):
        enu_to_ecef(*place)
