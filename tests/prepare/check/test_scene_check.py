"""`panolog scene check` finds what is wrong with a town that was broken, and nothing in sound scenes."""

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from itertools import cycle
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from panolog.orchestrator.engine.stages.measuring import measure_captures
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.state import ignore
from panolog.prepare.check.blank import find_blank
from panolog.prepare.check.misplaced import find_misplaced, misplaced_lines
from panolog.prepare.check.scene_check import check_scene
from panolog.scene.colmap import read_colmap, write_colmap
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.synthetic import make_town
from tests.data import shared
from tests.scenes import write_image

pytestmark = pytest.mark.system

Array = NDArray[np.float64]


Breakage = Callable[[Scene, Path], Scene]  # gets a folder for pictures


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return read_scene(make_town(tmp_path_factory.mktemp("town"), panoramas=8, width=256, points=2500))


def rotations(town: Scene) -> Array:
    return np.stack([panorama.rotation for panorama in town.panoramas])


def posed(town: Scene, rotations: Array, centers: Array | None = None) -> Scene:
    """The scene with other poses, (K, 3, 3) and (K, 3)."""
    poses = zip(town.panoramas, rotations, town.centers if centers is None else centers, strict=True)
    return replace(
        town, panoramas=tuple(replace(it, rotation=R, translation=-R @ center) for it, R, center in poses)
    )


def pictured(town: Scene, images: Iterable[Path]) -> Scene:
    """The scene with other pictures."""
    pairs = zip(town.panoramas, images, strict=True)
    return replace(town, panoramas=tuple(replace(panorama, image=image) for panorama, image in pairs))


def without_tracks(town: Scene) -> Scene:
    nothing = np.empty(0, np.int64)
    return replace(town, panoramas=tuple(replace(it, observed=nothing) for it in town.panoramas))


def displaced(town: Scene, pixels: float, folder: Path) -> Scene:
    """The scene with observations that lie elsewhere by so many pixels, each way."""
    model = read_colmap(town.root / "sparse" / "0")
    write_colmap(
        folder / "sparse" / "0",
        [(image.name, image.rotation, image.translation) for image in model.images],
        width=town.width,
        height=town.height,
        points=model.points,
        colors=model.colors,
        observations=[(image.points, image.pixels + pixels) for image in model.images],
    )
    return replace(town, root=folder)


def mirrored(town: Scene, _: Path) -> Scene:
    """The world was mirrored, and the poses made rotations again."""
    flip = np.diag([-1.0, 1.0, 1.0])
    return replace(posed(town, flip @ rotations(town) @ flip, town.centers @ flip), points=town.points @ flip)


def inverse(town: Scene, _: Path) -> Scene:
    """Camera-to-world poses, written as world-to-camera."""
    centers = -np.einsum("kij,kj->ki", rotations(town), town.centers)
    return posed(town, rotations(town).transpose(0, 2, 1), centers)


def centres_as_translations(town: Scene, _: Path) -> Scene:
    return posed(town, rotations(town), -np.einsum("kji,kj->ki", rotations(town), town.centers))


def noise(town: Scene, folder: Path) -> Scene:
    random, paths = np.random.default_rng(3), [folder / panorama.name for panorama in town.panoramas]
    for path in paths:
        write_image(path, random, (town.width, town.height))
    return pictured(town, paths)


def shuffled(town: Scene, _: Path) -> Scene:
    """Three pictures have each other's names, and so poses."""
    return pictured(town, [town.panoramas[it].image for it in (0, 4, 2, 3, 6, 5, 1, 7)])


BROKEN: dict[str, tuple[Breakage, str]] = {
    "OpenGL": (
        lambda it, _: posed(it, np.diag([1.0, -1.0, -1.0]) @ rotations(it)),
        "the cameras have y up and z backward",
    ),
    "points with another up": (
        lambda it, _: replace(it, points=it.points[:, [0, 2, 1]] * (1, -1, 1)),
        "the points are in another world than the poses: (x, y, z) of the poses are (x, z, -y)",
    ),
    "mirrored": (mirrored, "the scene is mirrored: left and right are exchanged"),
    "longitude 0 at the seam": (
        lambda it, _: posed(it, np.diag([-1.0, 1.0, -1.0]) @ rotations(it)),
        "longitude 0 is half a turn away",
    ),
    "inverse": (inverse, "the poses are camera-to-world, not world-to-camera"),
    "centres": (centres_as_translations, "the translations are camera centres"),
    "shuffled": (shuffled, "3 of 8 pictures fit another's pose better; street_00"),
    "noise": (noise, "points and pixels hardly correlate"),
}


SINGLE: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {  # of one pose, (3, 3) and (3,)
    "at random": lambda R, C: (Rotation.random(random_state=3).as_matrix(), C + np.array([3.0, -4.0, 2.0])),
    "kilometres away": lambda R, C: (R, C + np.array([8000.0, 50.0, -3000.0])),
    "in another street": lambda R, C: (R, C + np.array([0.0, 5.0, 1.0])),
}


@pytest.mark.parametrize(("kind", "tracks"), [*((kind, False) for kind in SINGLE), ("at random", True)])
def test_single_poses_are_named(kind: str, tracks: bool, town: Scene) -> None:
    poses, centers = rotations(town), town.centers.copy()
    for row in (2, 6):
        poses[row], centers[row] = SINGLE[kind](poses[row], centers[row])
    found = check_scene(posed(town if tracks else without_tracks(town), poses, centers))
    wrong = [town.panoramas[row].name for row in (2, 6)]
    assert list(found.misplaced) == wrong
    assert [problem.split(" is not where its pose says: ")[0] for problem in found.problems] == [
        f"pose: {name}" for name in wrong
    ]
    assert found.verdict.startswith("verdict: 2 of 8 panoramas fit no more than by chance")


def test_a_panorama_that_shows_nothing_or_is_damaged_is_not_misplaced(town: Scene, tmp_path: Path) -> None:
    blank, damaged = tmp_path / "blank.png", tmp_path / "damaged.png"
    cv2.imwrite(str(blank), np.full((town.height, town.width, 3), 90, np.uint8))
    damaged.write_bytes(b"no picture")
    images = [panorama.image for panorama in town.panoramas]
    assert find_misplaced(pictured(without_tracks(town), [blank, damaged, *images[2:]])) == {}


def test_panoramas_of_one_color_are_named(town: Scene, tmp_path: Path) -> None:
    """Training learnt their colour. One that is masked altogether is not trained on."""
    images, mask = [panorama.image for panorama in town.panoramas], tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.zeros((town.height, town.width), np.uint8))
    blank = {1: 0, 4: 200}
    for row, color in blank.items():
        images[row] = tmp_path / f"{row}.jpg"
        cv2.imwrite(str(images[row]), np.full((town.height, town.width, 3), color, np.uint8))
    scene = pictured(town, images)
    names = [town.panoramas[row].name for row in blank]
    found, warned = check_scene(scene), list[str]()
    assert list(found.blank) == names
    measure_captures(scene, RunConfig(width=64), ignore, warned.append)
    said = " ".join(it for it in warned if "of one other colour" in it)
    assert all(name in found.problems[0] and name in said for name in names)
    others = [replace(it, mask=mask if row in blank else None) for row, it in enumerate(scene.panoramas)]
    assert find_blank(replace(scene, panoramas=tuple(others))) == []


def test_many_misplaced_panoramas_are_all_named() -> None:
    lines = misplaced_lines({f"{row}.jpg": "why" for row in range(23)})
    assert len(lines) == 21
    assert lines[-1] == "pose: 3 more are not: 20.jpg, 21.jpg, 22.jpg"


@pytest.mark.parametrize("tracks", [True, False])
def test_a_camera_far_away_is_named_without_colors_and_tracks(tracks: bool, town: Scene) -> None:
    centers = town.centers.copy()
    centers[5] += 8000.0
    grey = replace(posed(town, rotations(town), centers), colors=np.full_like(town.colors, 128))
    found = find_misplaced(grey if tracks else without_tracks(grey))
    assert list(found) == [town.panoramas[5].name]
    assert ("px from where" if tracks else "farther from all others") in found[town.panoramas[5].name]


@pytest.mark.parametrize("tracks", [True, False])
def test_a_sound_town(tracks: bool, town: Scene) -> None:
    found = check_scene(town if tracks else without_tracks(town))
    assert found.problems == ()
    assert found.verdict == "verdict: poses, points and panoramas fit together"
    assert found.color_correlation is not None
    assert found.color_correlation > 0.6
    assert found.patch_correlation > 0.6 or not tracks
    assert np.abs(np.array(found.up) - (0, 0, 1)).max() < 0.1
    assert (found.reprojection_px is not None) == tracks
    assert "up is about +z" in "\n".join(found.lines())
    assert json.loads(json.dumps(asdict(found)))["problems"] == []


@pytest.mark.parametrize(("kind", "tracks"), list(zip(BROKEN, cycle([True, False]))))
def test_a_broken_town(kind: str, tracks: bool, town: Scene, tmp_path: Path) -> None:
    breakage, words = BROKEN[kind]
    (problem,) = check_scene(breakage(town if tracks else without_tracks(town), tmp_path)).problems
    assert words in problem
    assert "\n" not in problem


@pytest.mark.parametrize("tracks", [True, False])
def test_half_a_pixel_in_the_poses(tracks: bool, town: Scene, tmp_path: Path) -> None:
    """As openMVG writes poses and tracks: pixel centres at whole numbers."""
    turn = Rotation.from_euler("y", -np.pi / town.width).as_matrix()
    wrong = displaced(posed(town, turn @ rotations(town)), -0.5, tmp_path)
    found = check_scene(wrong if tracks else without_tracks(wrong))
    assert any(problem.startswith("pixels: the pictures lie (+0.") for problem in found.problems)
    assert found.picture_shift_px is not None
    assert abs(found.picture_shift_px[0] - 0.5) < 0.2


@pytest.mark.parametrize("tracks", [True, False])
def test_a_cloud_without_colors(tracks: bool, town: Scene, tmp_path: Path) -> None:
    """Then patches tell, and tracks where there are any."""
    grey = replace(town if tracks else without_tracks(town), colors=np.full_like(town.colors, 128))
    found = check_scene(grey)
    assert found.problems == ()
    assert found.color_correlation is None
    assert "the points have no colours" in "\n".join(found.lines())
    (problem,) = check_scene(inverse(grey, tmp_path)).problems
    assert ("the poses are camera-to-world" if tracks else "hardly correlate") in problem


def test_a_model_whose_images_have_no_lines_of_observations(town: Scene, tmp_path: Path) -> None:
    """Points name the images that see them, but not where: all colours counted as wrong."""
    model = read_colmap(town.root / "sparse" / "0")
    shutil.copytree(town.root / "images", tmp_path / "images")
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 EQUIRECTANGULAR {town.width} {town.height}\n")
    poses = [
        " ".join(
            map(str, [row, *Rotation.from_matrix(it.rotation).as_quat(scalar_first=True), *it.translation, 1])
        )
        for row, it in enumerate(model.images, 1)
    ]
    lines = [f"{pose} {it.name}" for pose, it in zip(poses, model.images, strict=True)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    seen = [np.isin(np.arange(len(model.points)), it.observed) for it in model.images]
    tracks = [
        " ".join(f"{row} 0" for row, own in enumerate(seen, 1) if own[point]) for point in range(len(seen[0]))
    ]
    rows = zip(model.points, model.colors, tracks, strict=True)
    points = [
        f"{n} {x} {y} {z} {r} {g} {b} 0 {track}" for n, ((x, y, z), (r, g, b), track) in enumerate(rows, 1)
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    found = check_scene(read_scene(tmp_path))
    assert found.problems == ()
    assert found.observations > 0 and found.reprojection_px is None
    assert found.color_correlation is not None and found.color_correlation > 0.6


def test_the_same_point_thousands_of_times_counts_once(town: Scene) -> None:
    """The exposures and the shift were those of one point."""
    plain = without_tracks(town)
    copies = np.concatenate([np.arange(len(town.points)), np.zeros(5000, np.int64)])
    many = check_scene(replace(plain, points=town.points[copies], colors=town.colors[copies]))
    assert many.picture_shift_px == check_scene(plain).picture_shift_px


def test_the_colours_of_six_points_say_nothing(town: Scene) -> None:
    """Six fit some wrong convention by chance."""
    few = replace(without_tracks(town), points=town.points[:6], colors=town.colors[:6])
    found = check_scene(few)
    assert found.color_correlation is None
    assert not [it for it in found.problems if it.startswith(("axes", "names", "pixels"))]


def test_half_a_pixel_in_the_tracks(town: Scene, tmp_path: Path) -> None:
    (problem,) = check_scene(displaced(town, -0.5, tmp_path)).problems
    assert problem.startswith("tracks: the observations lie (-0.")


def test_poses_that_fit_in_no_convention(town: Scene) -> None:
    """Each is turned by some degrees of its own."""
    turns = Rotation.from_rotvec(np.random.default_rng(5).normal(0, 0.15, (8, 3))).as_matrix()
    found = check_scene(posed(town, turns @ rotations(town)))
    assert any("the points miss their observations by" in problem for problem in found.problems)


@pytest.mark.parametrize(("name", "tracks"), [("street", True), ("flat", False)])
def test_shared_scenes_are_sound(name: str, tracks: bool) -> None:
    """What hides points without tracks must not be taken for a pixel convention."""
    scene = read_scene(shared(name))
    some = scene.panoramas[:: len(scene.panoramas) // 5]
    few = replace(scene, panoramas=some, train=tuple(range(len(some))), test=())
    found = check_scene(few if tracks else without_tracks(few))
    assert found.problems == ()
    assert (found.reprojection_px is not None) == tracks
    assert found.color_correlation is not None
    assert found.color_correlation > (0.8 if tracks else 0.6)
