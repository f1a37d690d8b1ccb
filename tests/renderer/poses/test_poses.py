import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.renderer.poses import read_poses, smooth_path
from panolog.scene.errors import InputError
from panolog.scene.model import Panorama

TURN = Rotation.from_euler("y", 90, degrees=True)  # camera-to-world: looks along +x
CENTER = np.array([1.0, 2.0, 3.0])


def write(folder: Path, text: str, name: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def line(values: object) -> str:
    return " ".join(map(repr, np.asarray(values).tolist()))


def test_three_formats_say_the_same(tmp_path: Path) -> None:
    matrix = np.column_stack([TURN.as_matrix(), CENTER])
    inverse = TURN.inv()
    x, y, z, w = inverse.as_quat()
    tum = write(
        tmp_path, f"# time tx ty tz qx qy qz qw\n12.5 {line(CENTER)} {line(TURN.as_quat())}\n", "a.txt"
    )
    colmap = write(
        tmp_path,
        f"# images\n1 {line([w, x, y, z])} {line(-inverse.apply(CENTER))} 1 my pano.jpg\n\n",
        "b.txt",
    )
    listed = write(tmp_path, json.dumps([{"name": "first", "camera_to_world": matrix.tolist()}]), "c.json")
    for path, name in ((tum, "12.5"), (colmap, "my pano.jpg"), (listed, "first")):
        (pose,) = read_poses(path)
        assert pose.name == name
        np.testing.assert_allclose(pose.rotation, TURN.as_matrix().T, atol=1e-12)
        np.testing.assert_allclose(-pose.rotation.T @ pose.translation, CENTER, atol=1e-12)


def test_colmap_images_with_points_and_without(tmp_path: Path) -> None:
    text = "1 1 0 0 0 0 0 0 1 a.jpg\n1.5 2.5 -1 3 4 7\n2 1 0 0 0 1 0 0 1 b.jpg\n\n3 1 0 0 0 2 0 0 1 c.jpg"
    poses = read_poses(write(tmp_path, text, "images.txt"))
    assert [pose.name for pose in poses] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [pose.translation[0] for pose in poses] == [0, 1, 2]


TEXT = [
    ("", "no pose"),
    ("# only a comment\n\n", "no pose"),
    ("0 0 0 0 0 0 0 1\n0 0 0\n", "poses.txt:2: .* 3 fields"),
    ("0 0 0 zero 0 0 0 1\n", "poses.txt:1: .*zero"),
    ("0 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 0 2\n", "poses.txt:3: the quaternion has the length 2"),
    ("0 nan 0 0 0 0 0 1\n", "poses.txt:1: .*finite"),
    ("1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0\n", "poses.txt:3: .*id qw"),
    ("1 0 0 0 0 0 0 0 1 a.jpg\n", "poses.txt:1: the quaternion has the length 0"),
]
JSON = [
    ("[\n{,\n]", r"poses.json:2: is not JSON"),
    ("{}", "list of poses"),
    ("[]", "no pose"),
    ('[{"name": "a"}]', "entry 0: has no camera_to_world"),
    ('[{"camera_to_world": [[1, 2], [3]]}]', "entry 0: .*rows of 4"),
    ('[{"camera_to_world": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]', "entry 0: .*rows of 4"),
    ('[{"camera_to_world": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}]', "scaled or mirrored"),
    ('[{"camera_to_world": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}]', "scaled or mirrored"),
    ('[{"camera_to_world": [[1, 0, 0, NaN], [0, 1, 0, 0], [0, 0, 1, 0]]}]', "finite"),
]


@pytest.mark.parametrize(
    ("name", "text", "words"), [*(("poses.txt", *it) for it in TEXT), *(("poses.json", *it) for it in JSON)]
)
def test_nonsense_is_refused_with_its_place(tmp_path: Path, name: str, text: str, words: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path / name)
    with pytest.raises(InputError, match=words) as refused:
        read_poses(write(tmp_path, text, name))
    assert "\n" not in str(refused.value)


def panorama(center: list[float], yaw: float) -> Panorama:
    rotation = Rotation.from_euler("y", yaw, degrees=True).as_matrix().T
    return Panorama("p", Path("p"), rotation, -rotation @ np.array(center), np.empty(0, np.int64))


def test_the_path_goes_through_the_cameras_at_constant_speed() -> None:
    stops: list[list[float]] = [[0, 0, 0], [2, 0, 0], [2, 0, 0], [4, 0, 0], [4, 0, 4]]
    poses = smooth_path([panorama(c, 10 * i) for i, c in enumerate(stops)], 81)
    places = np.array([-pose.rotation.T @ pose.translation for pose in poses])
    for stop in stops:
        assert np.linalg.norm(places - stop, axis=1).min() < 1e-9
    assert places[:, 0].max() <= 4 + 1e-9  # it does not swing out at the corner
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.2
    for pose in poses:
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(poses[-1].rotation, panorama([0, 0, 0], 40).rotation, atol=1e-9)


@pytest.mark.parametrize(
    ("places", "frames", "words"),
    [([0, 1], 1, "two frames"), *(([0] * count, 10, "two different positions") for count in (0, 1, 3))],
)
def test_a_path_needs_two_frames_and_two_places(places: list[float], frames: int, words: str) -> None:
    with pytest.raises(InputError, match=words):
        smooth_path([panorama([x, 2, 3], 0) for x in places], frames)
