"""Tables of poses: what their headers mean, and which do not decide."""

import math
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.importers.import_scene import choose_format
from panolog.prepare.importers.interface import ImportedScene, ImportSource
from panolog.prepare.importers.pose_table import read
from panolog.prepare.world.exif import Attitude
from panolog.scene.errors import InputError

EAST, NORTH, UP = np.eye(3)


def table(folder: Path, text: str, suffix: str = "csv", encoding: str = "utf-8") -> ImportSource:
    for name in ("a.jpg", "b.jpg"):
        (folder / name).touch()
    (folder / f"poses.{suffix}").write_text(text, encoding=encoding)
    return ImportSource(folder / f"poses.{suffix}")


def parsed(folder: Path, text: str, suffix: str = "csv") -> ImportedScene:
    source = table(folder, text, suffix)
    assert choose_format(source, None) == "poses"
    return read(source)


def test_heading_pitch_and_roll_are_those_of_gpano(tmp_path: Path) -> None:
    found = parsed(tmp_path, "name,x,y,z,heading,pitch,roll\na,1,2,3,90,0,0\nb.jpg,4,5,6,200,10,-5\n")
    first, second = found.images
    np.testing.assert_allclose(first.rotation @ EAST, [0, 0, 1], atol=1e-12)  # it looks east
    np.testing.assert_allclose(first.rotation @ UP, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(-first.rotation.T @ first.translation, [1, 2, 3])
    np.testing.assert_allclose(second.rotation @ UP, Attitude(200, 10, -5).up, atol=1e-12)
    ahead = second.rotation.T @ [0, 0, 1]
    assert math.degrees(math.atan2(ahead[0], ahead[1])) % 360 == pytest.approx(200)
    assert list(found.notes) == ["poses.csv: x is taken as east, y as north, z as up"]


def test_yaw_of_programs_whose_cameras_look_down_at_a_pitch_of_0(tmp_path: Path) -> None:
    """The matrix is what a user of Metashape has published for ypr2mat((30, 91, 0)): see the module."""
    known = np.array(
        [
            [0.8660254037844385, -0.008726203218641737, -0.4999238475781956],
            [-0.49999999999999994, -0.01511422733185856, -0.8658935039207541],
            [0.0, 0.9998476951563913, -0.017452406437283477],
        ]
    )
    text = "#Label;X/East;Y;Z;Yaw;Pitch;Roll\na;0;0;0;30;91;0\nb;1,5;0;0;210;89;180\n"
    found = parsed(tmp_path, text.replace("X/East", "Easting"))
    for image in found.images:
        np.testing.assert_allclose(image.rotation.T, known @ np.diag([1, -1, -1]), atol=1e-9)
    assert -found.images[1].rotation.T @ found.images[1].translation == pytest.approx([1.5, 0, 0])


@pytest.mark.parametrize("head", ["omega_rad,phi_rad,kappa_rad", "Omega [rad],Phi [rad],Kappa [rad]"])
def test_radians_by_name(head: str, tmp_path: Path) -> None:
    found = parsed(tmp_path, f"name,x,y,z,{head}\na,0,0,0,1.5707963267948966,0,0\nb,0,0,1,0,0,0\n")
    level, down = (image.rotation.T @ [0, 0, 1] for image in found.images)
    np.testing.assert_allclose(level, NORTH, atol=1e-12)  # omega of 90 degrees lifts it to the horizon
    np.testing.assert_allclose(down, -UP, atol=1e-12)


@pytest.mark.parametrize("suffix", ["csv", "txt", "tsv"])
def test_separators_comments_and_other_columns(suffix: str, tmp_path: Path) -> None:
    separator = {"csv": ",", "txt": "  ", "tsv": "\t"}[suffix]
    lines = [
        "# made by hand",
        "",
        separator.join(["Z", "file", "QW", "qx", "qy", "qz", "X", "Y", "accuracy"]),
    ]
    lines += ["# the first", separator.join(["3", "a.jpg", "1", "0", "0", "0", "1", "2", "9"])]
    lines += [separator.join(["6", "b.jpg", "0.7071", "0", "0.7071", "0", "4", "5", "9"]), ""]
    found = parsed(tmp_path, "\n".join(lines).replace("# made by hand\n\n", "# made by hand\n"), suffix)
    assert [image.name for image in found.images] == ["a.jpg", "b.jpg"]
    np.testing.assert_allclose(found.images[0].translation, [-1, -2, -3])
    np.testing.assert_allclose(found.images[1].rotation.T @ [0, 0, 1], [1, 0, 0], atol=1e-4)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_a_table_of_a_spreadsheet_and_of_realityscan(encoding: str, tmp_path: Path) -> None:
    text = "#name x y alt heading pitch roll\na.jpg 1 2 3 90 0 0\nb.jpg 4 5 6 200 10 -5\n".replace(" ", "\t")
    source = table(tmp_path, "\ufeff" * (encoding == "utf-16-be") + text, encoding=encoding)
    assert choose_format(source, None) == "poses"
    first = read(source).images[0]
    np.testing.assert_allclose(-first.rotation.T @ first.translation, [1, 2, 3])


HEAD = "name,x,y,z,qw,qx,qy,qz"
UNCLEAR = {
    "no attitude": (
        "name,x,y,z\na,1,2,3\n",
        "has no attitude; add qw, qx, qy, qz; or omega, phi, kappa; or yaw",
    ),
    "two attitudes": (f"{HEAD},yaw,pitch,roll\n", "has several attitudes (qw, qx, qy, qz; yaw, pitch, roll)"),
    "half an attitude": ("name,x,y,z,omega,kappa\n", "lacks phi of omega, phi, kappa"),
    "numbered quaternion": (
        "name,x,y,z,q0,q1,q2,q3\n",
        "has q0, q1, q2, q3: which of its numbers is the real",
    ),
    "translations": (
        "name,tx,ty,tz,qw,qx,qy,qz\n",
        "has tx, ty, tz: a translation is not where the camera is",
    ),
    "on the earth": ("name,latitude,longitude,z,yaw,pitch,roll\n", "has latitude, longitude: project"),
    "two columns": (f"{HEAD},altitude\n", "has several columns for z; leave one of each"),
    "yaw and heading": ("name,x,y,z,yaw,heading,pitch,roll\n", "has several columns for yaw"),
    "no unit": (
        "name,x,y,z,omega,phi,kappa\na,0,0,0,1,2,3\n",
        "may be degrees or radians, as none is above 2 pi",
    ),
    "two units": ("name,x,y,z,omega_rad,phi_rad,kappa_deg\na,0,0,0,1,2,30\n", "in different units; give one"),
    "pitches of all kinds": (
        "name,x,y,z,yaw,pitch,roll\na,0,0,0,10,0,0\nb,0,0,0,20,90,0\n",
        "pitch is that of level cameras neither by 0 nor by 90 degrees (0 to 90)",
    ),
    "no number": (f"{HEAD}\na,0,0,x,1,0,0,0\n", "line 2: z: 'x' is no number of a pose"),
    "no quaternion": (f"{HEAD}\na,0,0,0,1,1,0,0\n", "line 2: its quaternion has length 1.41, not 1"),
    "a short line": (f"{HEAD}\n\na,0,0,0,1,0,0\n", "line 3: has 7 cells; the header has 8"),
    "no picture": (f"{HEAD}\nc,0,0,0,1,0,0,0\n", "line 2: c is not in"),
    "outside": (f"{HEAD}\n../a,0,0,0,1,0,0,0\n", "line 2: the image name '../a' is not a path inside"),
}


@pytest.mark.parametrize("case", UNCLEAR)
def test_what_the_header_does_not_decide_is_one_clear_line(case: str, tmp_path: Path) -> None:
    text, words = UNCLEAR[case]
    source = table(tmp_path, text)
    assert choose_format(source, None) == "poses"
    with pytest.raises(InputError) as caught:
        read(source)
    assert words in str(caught.value) and "poses.csv: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "a,b,c\n1,2,3\n", "1 2 3 4 5 6 7 8\n", "\0" * 99])
def test_other_files_are_no_tables(text: str, tmp_path: Path) -> None:
    source = table(tmp_path, text)
    with pytest.raises(InputError, match="is of no format that can be imported"):
        choose_format(source, None)
    with pytest.raises(InputError, match="has no header with name, x, y, z and an attitude"):
        read(source)
