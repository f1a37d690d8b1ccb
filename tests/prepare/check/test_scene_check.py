"""`panolog scene check` finds what is wrong with a town that was broken, and nothing in sound scenes."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.check.scene_check import check_scene
from panolog.scene.read import read_scene
from panolog.synthetic import make_town
from tests.data import shared
from tests.prepare.check import broken
from tests.prepare.check.broken import Breakage, Town, read_town, write_town


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return read_town(make_town(tmp_path_factory.mktemp("town"), panoramas=8, width=256, points=2500))


@pytest.mark.parametrize("tracks", [True, False])
def test_a_sound_town(tracks: bool, town: Town, tmp_path: Path) -> None:
    found = check_scene(read_scene(write_town(town, tmp_path / "scene", tracks=tracks)))
    assert found.problems == ()
    assert found.color_correlation is not None
    assert found.color_correlation > 0.6
    assert found.patch_correlation > 0.6 or not tracks
    assert np.abs(np.array(found.up) - (0, 0, 1)).max() < 0.1
    assert (found.reprojection_px is not None) == tracks
    assert "up is about +z" in "\n".join(found.lines())
    assert json.loads(json.dumps(asdict(found)))["problems"] == []


@pytest.mark.parametrize("tracks", [True, False])
@pytest.mark.parametrize(
    ("breakage", "words"),
    [
        (broken.opengl, "the cameras have y up and z backward"),
        (
            broken.z_up_points,
            "the points are in another world than the poses: (x, y, z) of the poses are (x, z, -y)",
        ),
        (broken.mirrored, "the scene is mirrored: left and right are exchanged"),
        (broken.half_turn, "longitude 0 is half a turn away"),
        (broken.inverse, "the poses are camera-to-world, not world-to-camera"),
        (broken.centres, "the translations are camera centres"),
        (broken.shuffled, "3 of 8 pictures fit another's pose better; street_00"),
        (broken.other_pictures, "points and pixels hardly correlate"),
    ],
)
def test_a_broken_town(breakage: Breakage, words: str, tracks: bool, town: Town, tmp_path: Path) -> None:
    found = check_scene(read_scene(write_town(breakage(town), tmp_path / "scene", tracks=tracks)))
    assert len(found.problems) == 1
    assert words in found.problems[0]
    assert "\n" not in found.problems[0]


@pytest.mark.parametrize("tracks", [True, False])
def test_half_a_pixel_in_the_poses(tracks: bool, town: Town, tmp_path: Path) -> None:
    scene = write_town(broken.half_pixel_poses(town), tmp_path / "scene", tracks=tracks)
    found = check_scene(read_scene(scene))
    assert any(problem.startswith("pixels: the pictures lie (+0.") for problem in found.problems)
    assert found.picture_shift_px is not None
    assert abs(found.picture_shift_px[0] - 0.5) < 0.2


@pytest.mark.parametrize("tracks", [True, False])
def test_a_cloud_without_colors(tracks: bool, town: Town, tmp_path: Path) -> None:
    """Then patches tell, and tracks where there are any."""
    grey = replace(town, colors=np.full_like(town.colors, 128))
    found = check_scene(read_scene(write_town(grey, tmp_path / "sound", tracks=tracks)))
    assert found.problems == ()
    assert found.color_correlation is None
    assert "the points have no colours" in "\n".join(found.lines())
    wrong = write_town(broken.inverse(grey), tmp_path / "wrong", tracks=tracks)
    (problem,) = check_scene(read_scene(wrong)).problems
    assert ("the poses are camera-to-world" if tracks else "hardly correlate") in problem


def test_half_a_pixel_in_the_tracks(town: Town, tmp_path: Path) -> None:
    scene = write_town(broken.half_pixel_tracks(town), tmp_path / "scene", tracks=True)
    found = check_scene(read_scene(scene))
    (problem,) = found.problems
    assert problem.startswith("tracks: the observations lie (-0.")


def test_poses_that_fit_in_no_convention(town: Town, tmp_path: Path) -> None:
    scene = write_town(broken.far_off(town), tmp_path / "scene", tracks=True)
    found = check_scene(read_scene(scene))
    assert any("the points miss their observations by" in problem for problem in found.problems)


@pytest.mark.parametrize("name", ["street", "flat"])
def test_shared_scenes_are_sound(name: str) -> None:
    found = check_scene(read_scene(shared(name)))
    assert found.problems == ()
    assert found.color_correlation is not None
    assert found.color_correlation > 0.8


def test_a_real_scene_without_tracks() -> None:
    """What hides points there must not be taken for a pixel convention."""
    scene = read_scene(shared("flat"))
    bare = tuple(replace(panorama, observed=np.empty(0, np.int64)) for panorama in scene.panoramas)
    found = check_scene(replace(scene, panoramas=bare))
    assert found.problems == ()
    assert found.reprojection_px is None
