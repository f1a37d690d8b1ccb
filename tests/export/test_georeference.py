"""Where on the earth a model is."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from panolog.export.earth import geodetic_of
from panolog.export.georeference import Georeference, georeference_from, georeference_of
from panolog.scene.errors import ConfigError, SceneError
from panolog.scene.read import read_scene
from panolog.scene.write import Offset, Origin, write_offset
from tests.scenes import write_scene

MUNICH = Origin(latitude=48.137, longitude=11.575, altitude=520.0)


def test_east_north_up() -> None:
    place = Georeference(up=(0, 0, 1), offset=(100, 200, 300), origin=MUNICH, metres=1)
    ecef = place.to_ecef()
    assert ecef is not None
    latitude, longitude, height = geodetic_of((ecef @ [-100, -200, -300, 1])[:3])
    np.testing.assert_allclose((latitude, longitude, height), (48.137, 11.575, 520), atol=1e-6)
    north = geodetic_of((ecef @ [-100, 800, -300, 1])[:3])
    assert north[0] > 48.1459 and north[1] == pytest.approx(11.575)  # 1,000 m


def test_projected_coordinates() -> None:
    pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed")
    east, north = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(11.575, 48.137)
    place = Georeference(up=(0, 0, 1), middle=(5, 6, 7), offset=(east, north, 560), epsg=32632)
    ecef = place.to_ecef()
    assert ecef is not None
    np.testing.assert_allclose(geodetic_of(ecef[:3, 3]), (48.137, 11.575, 560), atol=1e-5)
    scale = np.linalg.norm(ecef[:3, :3], axis=0)  # that of UTM there
    np.testing.assert_allclose(scale, 1, atol=1e-3)
    with pytest.raises(ConfigError, match="EPSG:999999: cannot be converted"):
        replace(place, epsg=999_999).to_ecef()


def placed(epsg: int, offset: tuple[float, float, float], geoid: float | None = None) -> Georeference:
    pytest.importorskip("pyproj", reason="pyproj is not installed")
    return Georeference(up=(0, 0, 1), offset=offset, epsg=epsg, geoid=geoid)


def test_feet() -> None:
    """A model in feet is as large as it is, and as high: it was 3.28 times too large."""
    place = placed(2263, (987_000.0, 213_000.0, 1_000.0))
    foot = 1200 / 3937
    assert place.unit == pytest.approx(foot, rel=1e-9)
    ecef = place.to_ecef()
    assert ecef is not None
    np.testing.assert_allclose(np.linalg.norm(ecef[:3, :3], axis=0), foot, rtol=1e-3)
    assert geodetic_of(ecef[:3, 3])[2] == pytest.approx(1_000 * foot, abs=1e-3)
    with pytest.raises(
        ConfigError, match=r"EPSG:2263 has units of 0\.304801 m, not of 1 m; leave out the metres"
    ):
        _ = replace(place, metres=1.0).unit


@pytest.mark.parametrize(
    ("epsg", "words"),
    [
        (
            4326,
            r"EPSG:4326 \(WGS 84\): is in degree, and a model's axes are lengths; give a projected system",
        ),
        (4979, "is in degree and metre, and a model's axes are lengths"),
        (5773, "is in metre, and a model's axes are lengths"),  # heights alone
        (8360, "is in degree and metre"),  # degrees, with heights above the sea
    ],
)
def test_systems_that_models_cannot_be_in(epsg: int, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        _ = placed(epsg, (8.5, 47.3, 400.0)).unit


def test_heights_above_the_sea() -> None:
    """The geoid is 47 m above the ellipsoid at Zurich: so much too low the model used to be."""
    zurich = (465_000.0, 5_247_000.0, 400.0)
    with pytest.raises(
        ConfigError, match=r"EPSG:5555 .*: has heights above the sea, and .* give EPSG:25832 and"
    ):
        placed(5555, zurich).to_ecef()
    heights = {}
    for geoid in (None, 47.0):
        place = placed(25832, zurich, geoid)
        ecef = place.to_ecef()
        assert ecef is not None
        assert place.heights_known == (geoid is not None)
        heights[geoid] = geodetic_of(ecef[:3, 3])
    assert heights[None] == pytest.approx((47.3755213, 8.5363698, 400.0), abs=1e-3)
    assert heights[47.0] == pytest.approx((47.3755213, 8.5363698, 447.0), abs=1e-3)
    gps = Georeference(up=(0, 0, 1), origin=MUNICH, geoid=46.0).to_ecef()
    assert gps is not None
    assert geodetic_of(gps[:3, 3])[2] == pytest.approx(566.0, abs=1e-6)


def test_metres_that_contradict_the_place() -> None:
    with pytest.raises(ConfigError, match="in metres east, north and up of its place; leave out the metres"):
        _ = Georeference(origin=MUNICH, metres=0.5).unit


def test_a_scene_with_cameras_alone(tmp_path: Path) -> None:
    scene = read_scene(write_scene(tmp_path / "scene"))
    found = georeference_of(scene)  # its cameras are turned at random
    assert (found.up, found.origin, found.metres) == ((0, -1, 0), None, None)
    assert found.to_ecef() is None


def test_a_scene_with_a_place(tmp_path: Path) -> None:
    root = write_scene(tmp_path / "scene")
    write_offset(root, Offset(offset=(1, 2, 3), frame="ENU", origin=MUNICH))
    found = georeference_of(read_scene(root))
    assert (found.up, found.offset, found.metres) == ((0, 0, 1), (1, 2, 3), 1)
    content = json.loads(json.dumps(found.as_json({"scene": "abc"})))
    assert georeference_from(content, "georef.json") == found
    assert content["provenance"] == {"scene": "abc"}
    assert content["exports"]["wgs84"]["latitude"] == pytest.approx(48.137, abs=1e-3)
    np.testing.assert_array_equal(content["exports"]["rotation"], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.mark.parametrize(
    "content",
    [[], {}, {"model": {}, "exports": {}}, {"model": {"up": [0, 0], "origin": None, "offset": [0] * 3}}],
)
def test_georef_json_of_others(content: object) -> None:
    with pytest.raises(SceneError, match=r"^x\.json: is not of this PanoLOG's format"):
        georeference_from(content, "x.json")
