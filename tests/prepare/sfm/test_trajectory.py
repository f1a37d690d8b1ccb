"""Known trajectories: their two formats, how panoramas are found in them, and the world that they give."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.trajectory import fit_world, near_pairs, places_of, read_trajectory
from panolog.scene.errors import InputError

TUM = "# t x y z qx qy qz qw\n10.0 0 0 1 0 0 0 1\n12.0 4 2 1 0 0 0 1\n11.0 2 0 1 0 0 0 1\n"
NAMED = "name,x,y,z\na.jpg,0,0,1\nb.jpg,2,0,1\nd.jpg,4,2,1\n"


def _file(folder: Path, text: str) -> Path:
    path = folder / "walk.txt"
    path.write_text(text)
    return path


def test_tum_is_sorted_by_time_and_interpolated(tmp_path: Path) -> None:
    read = read_trajectory(_file(tmp_path, TUM))
    assert read.times is not None
    assert read.times.tolist() == [10, 11, 12]
    places = places_of(read, ["10.5.jpg", "12.jpg", "11.0.jpg", "99.jpg"], None)
    assert places[:3].tolist() == [[1, 0, 1], [4, 2, 1], [2, 0, 1]]
    assert np.isnan(places[3]).all()


def test_frames_of_a_video_count_from_its_beginning(tmp_path: Path) -> None:
    places = places_of(
        read_trajectory(_file(tmp_path, TUM)), ["v_0.jpg", "v_1.jpg", "v_2.jpg"], [0.0, 0.5, 2.0]
    )
    assert places.tolist() == [[0, 0, 1], [1, 0, 1], [4, 2, 1]]
    in_milliseconds = _file(tmp_path, TUM.replace(".0 ", "000 "))
    with pytest.raises(InputError, match="lasts 2,000 seconds, and the frames of the video 2"):
        places_of(read_trajectory(in_milliseconds), ["v_0.jpg", "v_1.jpg", "v_2.jpg"], [0.0, 0.5, 2.0])


@pytest.mark.parametrize(
    "names", [["a.jpg", "b.jpg", "c.jpg", "d.jpg"], ["x/a.png", "b.tif", "c.png", "d.jpg"]]
)
def test_csv_with_names(names: list[str], tmp_path: Path) -> None:
    places = places_of(read_trajectory(_file(tmp_path, NAMED + "a.jpg,0,0,1\n")), names, None)
    assert places[[0, 1, 3]].tolist() == [[0, 0, 1], [2, 0, 1], [4, 2, 1]]
    assert np.isnan(places[2]).all()


@pytest.mark.parametrize(
    "content, message",
    [
        (None, "there is no such file"),
        (b"\xff\xfe\x00\x01" * 9, "is not text"),
        (b"", "is empty"),
        (b"# only\n", "is empty"),
        (b"1 2 3\n", "line 1: is not 8 numbers"),
        (TUM.encode() + b"13 0 0 nan 0 0 0 1\n", "line 5: is not 8 numbers"),
        (b"name,x,y\na,1,2\n", "has no x, y and z"),
        (NAMED.encode() + b"# again\na.jpg,9,0,1\n", "lines 2 and 6: two places for a.jpg; remove one"),
        (b"x,y,z\n1,2,3\n", "neither name nor t"),
        (b"t,x,y,z\n1,2,3\n", "line 2: has 3 cells"),
        (b"t,x,y,z\n1,2,three,4\n", "line 2: is not 4 numbers"),
        (b"t,x,y,z\n", "a header only"),
    ],
)
def test_wrong_files_are_one_line(content: bytes | None, message: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "walk.txt").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_trajectory(tmp_path / "walk.txt")


def test_a_trajectory_of_other_panoramas(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="0 of 3 panoramas match it"):
        places_of(read_trajectory(_file(tmp_path, NAMED)), ["1.jpg", "2.jpg", "3.jpg"], None)


def test_pairs_are_those_that_are_near() -> None:
    places = np.array([[0.0, 0, 0], [1, 0, 0], [np.nan] * 3, [2.1, 0, 0], [9, 0, 0]])
    assert near_pairs(places, 1) == [(0, 1), (1, 3), (3, 4)]


def test_the_world_is_that_of_the_trajectory() -> None:
    random = np.random.default_rng(0)
    centers = random.normal(size=(20, 3)) * (5, 5, 0.3)
    turn = Rotation.from_euler("zyx", [0.7, 0.2, -0.4]).as_matrix()
    places = 2.5 * centers @ turn.T + (100, -20, 3)
    places[3] += 40  # a jump of the other device
    places[7] = np.nan
    fit = fit_world(centers, places)
    assert fit is not None
    similarity, left = fit
    assert similarity.scale == pytest.approx(2.5)
    assert left < 1e-6
    assert np.allclose(similarity.rotation, turn)


def test_a_straight_line_has_no_world() -> None:
    line = np.outer(np.arange(9.0), (1, 0, 0))
    assert fit_world(line, line) is None
