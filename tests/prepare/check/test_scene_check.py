"""`panolog scene check` finds what is wrong with a town that was broken, and nothing in sound scenes."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.prepare.check.scene_check import check_scene
from panolog.scene.colmap import Observations, read_colmap, write_colmap
from panolog.scene.read import read_scene
from panolog.synthetic import make_town
from tests.data import shared

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Town:
    """What a scene's files hold."""

    names: tuple[str, ...]
    rotations: Array  # (K, 3, 3)
    centers: Array  # (K, 3)
    points: Array  # (P, 3)
    colors: NDArray[np.uint8]
    observations: tuple[Observations, ...]
    width: int
    pictures: tuple[NDArray[np.uint8], ...]  # BGR

    def posed(self, rotations: Array, centers: Array | None = None) -> "Town":
        return replace(self, rotations=rotations, centers=self.centers if centers is None else centers)


def read_town(folder: Path) -> Town:
    model = read_colmap(folder / "sparse" / "0")
    images = sorted(model.images, key=lambda image: image.name)
    return Town(
        names=tuple(image.name for image in images),
        rotations=np.stack([image.rotation for image in images]),
        centers=np.stack([-image.rotation.T @ image.translation for image in images]),
        points=model.points,
        colors=model.colors,
        observations=tuple((image.points, image.pixels) for image in images),
        width=images[0].camera.width,
        pictures=tuple(np.asarray(cv2.imread(str(folder / "images" / image.name))) for image in images),
    )


def write_town(town: Town, folder: Path, *, tracks: bool) -> Path:
    (folder / "images").mkdir(parents=True)
    for name, picture in zip(town.names, town.pictures, strict=True):
        cv2.imwrite(str(folder / "images" / name), picture)
    none: Observations = (np.empty(0, np.int64), np.empty((0, 2)))
    translations = -np.einsum("kij,kj->ki", town.rotations, town.centers)
    write_colmap(
        folder / "sparse" / "0",
        list(zip(town.names, town.rotations, translations, strict=True)),
        width=town.width,
        height=town.width // 2,
        points=town.points,
        colors=town.colors,
        observations=town.observations if tracks else [none] * len(town.names),
    )
    return folder


def displaced(town: Town, pixels: float) -> Town:
    """Observations that lie elsewhere by so many pixels, each way."""
    return replace(town, observations=tuple((rows, where + pixels) for rows, where in town.observations))


def mirrored(town: Town) -> Town:
    """The world was mirrored, and the poses made rotations again."""
    flip = np.diag([-1.0, 1.0, 1.0])
    return replace(town.posed(flip @ town.rotations @ flip, town.centers @ flip), points=town.points @ flip)


def inverse(town: Town) -> Town:
    """Camera-to-world poses, written as world-to-camera."""
    centers = -np.einsum("kij,kj->ki", town.rotations, town.centers)
    return town.posed(town.rotations.transpose(0, 2, 1), centers)


def with_noise(town: Town) -> Town:
    """Pictures of another place."""
    random = np.random.default_rng(3)
    noise = tuple(random.integers(0, 256, picture.shape, np.uint8) for picture in town.pictures)
    return replace(town, pictures=noise)


def shuffled(town: Town) -> Town:
    """Three pictures have each other's names, and so poses."""
    return replace(town, pictures=tuple(town.pictures[it] for it in (0, 4, 2, 3, 6, 5, 1, 7)))


BROKEN: dict[str, tuple[Callable[[Town], Town], str]] = {
    "OpenGL": (
        lambda it: it.posed(np.diag([1.0, -1.0, -1.0]) @ it.rotations),
        "the cameras have y up and z backward",
    ),
    "points with another up": (
        lambda it: replace(it, points=it.points[:, [0, 2, 1]] * (1, -1, 1)),
        "the points are in another world than the poses: (x, y, z) of the poses are (x, z, -y)",
    ),
    "mirrored": (mirrored, "the scene is mirrored: left and right are exchanged"),
    "longitude 0 at the seam": (
        lambda it: it.posed(np.diag([-1.0, 1.0, -1.0]) @ it.rotations),
        "longitude 0 is half a turn away",
    ),
    "inverse": (inverse, "the poses are camera-to-world, not world-to-camera"),
    "centres as translations": (
        lambda it: it.posed(it.rotations, -np.einsum("kji,kj->ki", it.rotations, it.centers)),
        "the translations are camera centres",
    ),
    "shuffled": (shuffled, "3 of 8 pictures fit another's pose better; street_00"),
    "noise": (with_noise, "points and pixels hardly correlate"),
}


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
@pytest.mark.parametrize(("breakage", "words"), BROKEN.values(), ids=BROKEN)
def test_a_broken_town(
    breakage: Callable[[Town], Town], words: str, tracks: bool, town: Town, tmp_path: Path
) -> None:
    found = check_scene(read_scene(write_town(breakage(town), tmp_path / "scene", tracks=tracks)))
    assert len(found.problems) == 1
    assert words in found.problems[0]
    assert "\n" not in found.problems[0]


@pytest.mark.parametrize("tracks", [True, False])
def test_half_a_pixel_in_the_poses(tracks: bool, town: Town, tmp_path: Path) -> None:
    """As openMVG writes poses and tracks: pixel centres at whole numbers."""
    turn = Rotation.from_euler("y", -np.pi / town.width).as_matrix()
    wrong = displaced(town.posed(turn @ town.rotations), -0.5)
    found = check_scene(read_scene(write_town(wrong, tmp_path / "scene", tracks=tracks)))
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
    wrong = write_town(inverse(grey), tmp_path / "wrong", tracks=tracks)
    (problem,) = check_scene(read_scene(wrong)).problems
    assert ("the poses are camera-to-world" if tracks else "hardly correlate") in problem


def test_half_a_pixel_in_the_tracks(town: Town, tmp_path: Path) -> None:
    scene = write_town(displaced(town, -0.5), tmp_path / "scene", tracks=True)
    found = check_scene(read_scene(scene))
    (problem,) = found.problems
    assert problem.startswith("tracks: the observations lie (-0.")


def test_poses_that_fit_in_no_convention(town: Town, tmp_path: Path) -> None:
    """Each is turned by some degrees of its own."""
    turns = Rotation.from_rotvec(np.random.default_rng(5).normal(0, 0.15, (len(town.names), 3))).as_matrix()
    scene = write_town(town.posed(turns @ town.rotations), tmp_path / "scene", tracks=True)
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
