"""A district of blocks and a flight over it."""

from pathlib import Path

import numpy as np
import pytest

from panolog.scene.read import read_scene
from panolog.synthetic.__main__ import main
from panolog.synthetic.district import PITCH, district, flight_path
from panolog.synthetic.layout import ROAD
from panolog.synthetic.shapes import Convex


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
