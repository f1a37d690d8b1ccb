"""A district of blocks and a flight over it."""

from pathlib import Path

import numpy as np
import pytest

from panolog.scene.read import read_scene
from panolog.synthetic.__main__ import main
from panolog.synthetic.district import PITCH, district, flight_path
from panolog.synthetic.layout import ROAD
from panolog.synthetic.paint import Plain
from panolog.synthetic.shapes import Convex, Shape, box, ellipsoid, moved
from panolog.synthetic.trace import PanoramaRays, cast

GREY = Plain((0.5, 0.5, 0.5))


@pytest.mark.parametrize("quarters", range(4))
def test_moved_shapes_are_met_where_they_are(quarters: int) -> None:
    """Turning and moving the camera alike changes nothing."""
    shapes: list[Shape] = [box((1, 2, 0), (3, 5, 2), GREY), ellipsoid((-2, 1, 1), (0.5, 1.5, 1), GREY)]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    turn, center = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([0.3, -0.2, 1.6])
    shift = np.array([7.0, -4.0, 0.0])
    before, after = PanoramaRays(np.eye(3), center, 64, 1), PanoramaRays(turn.T, turn @ center + shift, 64, 1)
    there = moved(shapes, 7.0, -4.0, quarters)
    one, two = cast(shapes, before), cast(there, after)
    np.testing.assert_allclose(one.distance, two.distance, rtol=1e-4)
    np.testing.assert_array_equal(one.shape, two.shape)
    rows = np.isfinite(one.distance)
    points = [rays.origins + hits.distance * rays.directions for rays, hits in ((before, one), (after, two))]
    for old, new in zip(shapes, there, strict=True):
        normals = old.normal(points[0][:, rows]), new.normal(points[1][:, rows])
        np.testing.assert_allclose(turn @ normals[0], normals[1], atol=1e-3)
        paints = old.paint(points[0][:, rows], normals[0]), new.paint(points[1][:, rows], normals[1])
        np.testing.assert_allclose(*paints, atol=1e-3)


def test_streets_are_free_of_houses() -> None:
    shapes = [shape for shape in district(2, 3, 0) if isinstance(shape, Convex)]
    tall = [shape for shape in shapes if 3.5 < shape.radius < np.inf]
    assert len(tall) > 60
    for shape in tall:
        from_street = (shape.center[:2] + (0, PITCH / 2) + PITCH / 2) % PITCH - PITCH / 2
        assert np.abs(from_street).min() > ROAD


def test_a_flight_covers_the_district_between_its_heights() -> None:
    rotations, centers = flight_path(6, 4, 96, 0)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    assert 20 < centers[:, 2].min() < 30 and 55 < centers[:, 2].max() < 65
    assert np.ptp(centers[:, 0]) > 5 * PITCH and np.ptp(centers[:, 1]) > 3 * PITCH * 0.9
    assert (rotations[:, 1, 2] < -0.99).all()  # upright


def test_the_command_writes_scenes_of_any_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ["--panoramas", "3", "--width", "32", "--points", "20"]
    assert main(["flight", str(tmp_path / "a"), "--blocks", "1x1", *size]) == 0
    assert main(["town", str(tmp_path / "b"), *size]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "a"), str(tmp_path / "b")]
    scene = read_scene(tmp_path / "a")
    assert [panorama.name for panorama in scene.panoramas] == [f"flight_{i:03d}.png" for i in range(3)]
    assert len(scene.points) == 20


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["flight", "--blocks", "0x1"], "blocks is not possible"),
        (["city", "--panoramas", "1"], "a scene of 1 panoramas cannot be reconstructed: give 2"),
        (["town", "--panoramas", "1"], "a scene of 1 panoramas"),
        (["town", "--width", "66"], "a width of 66 is not possible"),
        (["town", "--width", "0"], "a width of 0"),
    ],
)
def test_nonsense_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, str(tmp_path / "c")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    with pytest.raises(SystemExit, match="2"):
        main(["flight", str(tmp_path / "c"), "--blocks", "six"])
    assert not (tmp_path / "c").exists()
