"""Photographs of a street are added to a scene of it whose poses are known, and of which nothing may move."""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.sfm.joining.join import join_scene
from panolog.prepare.sfm.pipeline import SfmSettings, workspace_folder
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.colmap import read_colmap
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.scene.write import NewScene, Offset, PosedImage, no_progress, write_scene
from tests.prepare.video.videos import Array, Shot, render, walk

pytestmark = pytest.mark.system

WIDTH, STEP, COUNT = 512, 0.9, 4
WORLD = Rotation.from_euler("xyz", (0.3, -0.8, 1.9)).as_matrix(), np.array([4.0, -1.0, 2.5])  # of the street


@dataclass(frozen=True, eq=False)
class Place:
    """A scene of a street, and photographs between its own, of which the last shows another place."""

    scene: Path
    more: Path
    truth: dict[str, Array]  # (3,) the centre of each new one in the scene's world


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder = tmp_path_factory.mktemp("jobs") / "place"
    (folder / "day 2").mkdir(parents=True)
    shots, images, mask = walk([STEP] * COUNT), [], folder / "mask.png"
    cv2.imwrite(str(mask), np.full((32, 64), 255, np.uint8))
    for row, shot in enumerate(shots):
        file = folder / f"{row}.png"
        cv2.imwrite(str(file), render(shot, WIDTH))
        turn = Rotation.from_euler("YXZ", shot.turn, degrees=True).as_matrix().T @ WORLD[0].T
        layers = {"masks": mask} if row == 1 else {}
        images.append(PosedImage(f"day_2/{row}.png", file, turn, -turn @ _there(shot), layers=layers))
    points = np.random.default_rng(1).normal(0, 3, (6, 3))
    new = NewScene(
        images,
        (WIDTH, WIDTH // 2),
        points,
        np.arange(18, dtype=np.uint8).reshape(6, 3),
        split={"train.txt": ["day_2/1", "day_2/2", "day_2/3"], "test.txt": ["day_2/0"]},
        offset=Offset(offset=(5.0, 6.0, 7.0)),
    )
    write_scene(folder / "scene", new, link=False)
    combined = folder / "scene" / "masks.given" / "day_2" / "1.png"
    combined.parent.mkdir(parents=True)
    combined.write_bytes(mask.read_bytes())
    affines = folder / "scene" / "sparse" / "0" / "depth_params.json"
    affines.write_text('{"day_2/0": {"scale": 1, "offset": 0}}')
    more = folder / "day 2"
    between = [replace(shot, along=shot.along + STEP / 2) for shot in shots[:3]]
    for row, shot in enumerate(between):
        cv2.imwrite(str(more / f"{row}.png"), render(shot, WIDTH - 128))
    (more / "copy.png").write_bytes((folder / "2.png").read_bytes())
    noise = np.random.default_rng(2).integers(0, 255, (WIDTH // 16, WIDTH // 8, 3), np.uint8)
    cv2.imwrite(str(more / "z.png"), cv2.resize(noise, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_CUBIC))
    truth = {f"place-day_2/{row}.png": _there(shot) for row, shot in enumerate(between)}
    return Place(folder / "scene", more, truth)


def _there(shot: Shot) -> Array:
    """(3,) where a shot was taken, in the scene's world."""
    return np.array(WORLD[0] @ [0.0, 0.0, shot.along] + WORLD[1])


def test_later_photographs_are_posed_and_nothing_moves(place: Place, tmp_path: Path) -> None:
    before, output = _digests(place.scene), tmp_path / "scene"
    for stage in ("matches", "poses"):
        with pytest.raises(KeyboardInterrupt):
            _join(place, output, stage)
        assert not output.exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("panolog.prepare.sfm.features.features_of", None)  # the features are there
        report = _join(place, output)
    assert _digests(place.scene) == before and not workspace_folder(output).exists()
    known, found = read_scene(place.scene), read_scene(output)
    of_name = {panorama.name: panorama for panorama in found.panoramas}
    for panorama in known.panoramas:
        same = of_name.pop(panorama.name)
        assert np.array_equal(same.rotation, panorama.rotation)
        assert np.array_equal(same.translation, panorama.translation)
        assert same.image.read_bytes() == panorama.image.read_bytes()
        assert (same.mask is None) == (panorama.mask is None)
    poses, others = (_poses(it) for it in (place.scene, output))
    assert poses == {name: pose for name, pose in others.items() if name in poses}
    count = len(known.points)
    assert np.array_equal(found.points[:count], known.points)
    assert np.array_equal(found.colors[:count], known.colors)
    assert len(found.points) > count + 100 and found.colors[count:].std() > 10
    assert of_name.keys() == place.truth.keys()
    for name, panorama in of_name.items():
        assert np.linalg.norm(panorama.center - place.truth[name]) < 0.01 * STEP
        assert len(panorama.observed) > 50
    assert {found.panoramas[row].name for row in found.test} == {"day_2/0.png"}
    assert len(found.train) == 6
    for file in ("offset.json", "sparse/0/depth_params.json", "masks.given/day_2/1.png"):
        assert (output / file).read_bytes() == (place.scene / file).read_bytes()
    said = json.loads((output / "sfm.json").read_text())
    assert said == report.as_json()
    assert said["into"] == {"scene": str(place.scene), "panoramas": 4, "given": 4, "joined": 3}
    assert [it["name"] for it in said["missing"]] == ["place-day_2/z.png"]
    lines = "\n".join(report.lines())
    assert lines.startswith(f"3 of 4 panoramas joined the 4 of {place.scene}, ")
    assert "place-day_2/copy.png: is a copy of day_2/2.png, left out" in lines
    assert (output / "sfm.png").is_file()


def test_what_shows_another_place_is_refused(place: Place, tmp_path: Path) -> None:
    before, more = _digests(place.scene), tmp_path / "more"
    more.mkdir()
    (more / "z.png").write_bytes((place.more / "z.png").read_bytes())
    with pytest.raises(InputError, match="of 1 panoramas 0 agree with its 4, without 1 panorama") as caught:
        join_scene([more], place.scene, tmp_path / "scene", SfmSettings(partial=True), no_progress)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists() and _digests(place.scene) == before


@pytest.mark.parametrize(
    ("settings", "option"),
    [
        (SfmSettings(distance=("a", "b", 2.0)), "--distance"),
        (SfmSettings(mapper="global"), "--mapper global"),
    ],
)
def test_settings_that_would_move_the_scene_are_refused(
    settings: SfmSettings, option: str, place: Place, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=option):
        join_scene([place.more], place.scene, tmp_path / "scene", settings, no_progress)


def _poses(scene: Path) -> dict[str, tuple[float, ...]]:
    """The numbers of each pose, as the model has them."""
    images = read_colmap(scene / "sparse" / "0").images
    return {it.name: (*it.quaternion.tolist(), *it.translation.tolist()) for it in images}


def _join(place: Place, output: Path, stage: str = "") -> SfmReport:
    """Adds the photographs, interrupted in a stage if one is given."""

    def interrupt(what: str, done: int, _: int) -> None:
        if what == stage and done:
            raise KeyboardInterrupt

    return join_scene([place.more], place.scene, output, SfmSettings(), interrupt)


def _digests(folder: Path) -> dict[str, str]:
    files = (it for it in sorted(folder.rglob("*")) if it.is_file())
    return {str(it): hashlib.sha256(it.read_bytes()).hexdigest() for it in files}
