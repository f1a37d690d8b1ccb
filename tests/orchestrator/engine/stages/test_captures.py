"""How panoramas were captured, as measured before Stage I, and what a run keeps of what Stage I learns."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from panolog.orchestrator.engine.stages.captures import save_captured, save_measured
from panolog.orchestrator.engine.stages.measuring import Measured, measure_captures
from panolog.orchestrator.engine.stages.movers import PICTURES, moving_share
from panolog.orchestrator.engine.stages.scenes import learnt_scene, measured_scene
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder
from panolog.renderer.motion import moved
from panolog.scene.colmap import read_colmap
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.capture.captured import Captured
from tests.scenes import write_scene


@pytest.fixture
def truth(tmp_path: Path) -> Scene:
    return read_scene(write_scene(tmp_path / "scene", points=400))


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    (tmp_path / "run").mkdir()
    return RunFolder(tmp_path / "run")


def shaken(scene: Scene) -> Scene:
    """The scene with all cameras moved, as if its files had them so."""
    rng, panoramas = np.random.default_rng(0), []
    for panorama in scene.panoramas:
        motion = np.concatenate([rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.05])
        rotation, translation = moved(panorama.rotation, panorama.translation, motion)
        panoramas.append(replace(panorama, rotation=rotation, translation=translation))
    return replace(scene, panoramas=tuple(panoramas))


def measured(scene: Scene, refine: bool | str) -> tuple[Measured, list[str]]:
    lines: list[str] = []
    config = RunConfig.model_validate({"poses": {"refine": refine}})
    return measure_captures(scene, config, lines.append, lines.append), lines


def test_poses_that_do_not_fit_their_tracks_are_adjusted(truth: Scene, folder: RunFolder) -> None:
    wrong = shaken(truth)
    found, lines = measured(wrong, "auto")
    assert found.adjusted is not None
    assert any("bundle adjustment has brought the median to" in line for line in lines)
    save_measured(folder, found, wrong)
    right = measured_scene(folder, wrong)
    before, after = (np.linalg.norm(each.centers - truth.centers, axis=1).max() for each in (wrong, right))
    assert after < 0.5 * before
    assert right.points.shape == truth.points.shape
    table = json.loads(folder.poses.read_text())["panoramas"]
    assert [row["name"] for row in table] == [panorama.name for panorama in truth.panoramas]
    assert table[0]["original"]["rotation"] == wrong.panoramas[0].rotation.tolist()
    assert table[0]["refined"]["rotation"] == right.panoramas[0].rotation.tolist()
    assert folder.sparse.is_dir()


def test_stage_one_adds_to_the_moves_of_the_adjustment(truth: Scene, folder: RunFolder) -> None:
    wrong = shaken(truth)
    found, _ = measured(wrong, True)
    save_measured(folder, found, wrong)
    scene = measured_scene(folder, wrong)
    rows = np.array(scene.train)
    pose = [
        np.column_stack([scene.panoramas[r].rotation, scene.panoramas[r].translation + 1.0]) for r in rows
    ]
    save_captured(folder, Captured(rows=rows, poses=np.stack(pose), at_bound=rows == rows[0]), scene)
    table = {row["name"]: row for row in json.loads(folder.poses.read_text())["panoramas"]}
    assert len(table) == len(scene.panoramas)
    first, held_out = wrong.panoramas[rows[0]], wrong.panoramas[scene.test[0]]
    assert table[first.name]["at_bound"] and not table[held_out.name]["at_bound"]
    assert table[first.name]["original"]["rotation"] == first.rotation.tolist()
    assert table[first.name]["moved"] == pytest.approx(np.sqrt(3), abs=0.3)
    assert table[held_out.name]["moved"] < 0.3


def test_poses_that_fit_or_are_not_to_be_refined_stay(truth: Scene) -> None:
    assert measured(truth, "auto")[0] == Measured(None, None)
    found, _ = measured(truth, True)
    assert found.adjusted is None
    assert found.captured is not None and found.captured.residuals is not None
    found, lines = measured(shaken(truth), False)
    assert found == Measured(None, None) and not any("poses" in line for line in lines)


def test_poses_and_their_model_are_written(folder: RunFolder, truth: Scene) -> None:
    scene = replace(truth, offset=(100.0, -20.0, 3.0))
    rows = np.array(scene.train)
    motion = np.array([0.02, 0, 0, 0, np.radians(0.5), 0])
    new = [moved(scene.panoramas[row].rotation, scene.panoramas[row].translation, motion) for row in rows]
    at_bound = np.arange(len(rows)) == 1
    captured = Captured(rows=rows, poses=np.stack([np.column_stack(pose) for pose in new]), at_bound=at_bound)
    save_captured(folder, captured, scene)

    table = json.loads(folder.poses.read_text())["panoramas"]
    assert [row["name"] for row in table] == [scene.panoramas[row].name for row in rows]
    assert [row["at_bound"] for row in table] == at_bound.tolist()
    assert table[0]["turned"] == pytest.approx(0.5)
    assert table[0]["pixels"] > 0 and table[0]["moved"] > 0
    loaded = pycolmap.Reconstruction(str(folder.sparse))
    assert loaded.num_images() == len(scene.panoramas)
    model = {image.name: image for image in read_colmap(folder.sparse).images}
    for row, (rotation, translation) in zip(rows, new, strict=True):
        image = model[scene.panoramas[row].name]
        assert image.rotation == pytest.approx(rotation)
        assert image.translation == pytest.approx(translation - rotation @ np.array(scene.offset))
        assert len(image.points) == len(scene.panoramas[row].observed)
    known = learnt_scene(folder, scene)
    assert known.panoramas[rows[0]].rotation == pytest.approx(new[0][0])


# Movers


CELLS = 8, 16


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return read_scene(write_scene(tmp_path / "scene", names=[f"walk/{i:02d}.jpg" for i in range(20)]))


def with_movers(scene: Scene, sizes: dict[int, int]) -> Captured:
    """Movers of so many rows of cells from the horizon down, by row of the panorama."""
    movers = np.zeros((len(scene.train), *CELLS), np.bool_)
    for at, row in enumerate(scene.train):
        movers[at, 4 : 4 + sizes.get(row, 0), 2:6] = True
    return Captured(rows=np.array(scene.train, np.int64), movers=movers)


def test_masks_shares_and_pictures_of_the_worst(scene: Scene, folder: RunFolder) -> None:
    sizes = {row: 1 + at % 3 for at, row in enumerate(scene.train[:12])}
    save_captured(folder, with_movers(scene, sizes), scene)
    content = json.loads(folder.mover_shares.read_bytes())
    shares = {item["name"]: item["share"] for item in content["panoramas"]}
    assert list(shares) == [scene.panoramas[row].name for row in scene.train]
    assert [share > 0 for share in shares.values()] == [row in sizes for row in scene.train]
    worst = [scene.panoramas[row].name for row in sizes if sizes[row] == 3]
    assert content["pictures"][: len(worst)] == worst and len(content["pictures"]) == PICTURES
    assert len(list(folder.movers.rglob("*.jpg"))) == PICTURES
    assert len(list(folder.movers.rglob("*.png"))) == 12
    name = worst[0]
    mask = cv2.imread(str(folder.mover_mask(name)), cv2.IMREAD_UNCHANGED)
    assert mask is not None and mask.dtype == np.uint8 and mask.shape == CELLS
    assert (mask[4:7, 2:6] == 0).all() and (mask == 255).sum() == mask.size - 12
    picture = cv2.imread(str(folder.mover_picture(name)))
    photograph = cv2.imread(str(scene.root / "images" / name))
    assert picture is not None and photograph is not None
    tinted = np.abs(picture.astype(int) - photograph).mean(axis=2)
    assert tinted[16:28, 8:24].mean() > 3 * tinted[:12].mean()


def test_later_stages_have_them_as_masks_and_so_has_a_scene_into_which_they_are_copied(
    scene: Scene, folder: RunFolder
) -> None:
    row = scene.train[0]
    save_captured(folder, with_movers(scene, {row: 2}), scene)
    learnt, panorama = learnt_scene(folder, scene), scene.panoramas[row]
    for masked in (learnt.panoramas[row], replace(panorama, mask=folder.mover_mask(panorama.name))):
        view = load_view(masked, row, 64)
        assert view.mask is not None and not view.mask[16:24, 8:24].any() and view.mask[:12].all()
    assert all(learnt.panoramas[other].movers is None for other in (*scene.train[1:], *scene.test))


def test_a_photograph_that_is_gone_has_no_picture(scene: Scene, folder: RunFolder) -> None:
    row = scene.train[0]
    scene.panoramas[row].image.unlink()
    save_captured(folder, with_movers(scene, {row: 2, scene.train[1]: 1}), scene)
    assert json.loads(folder.mover_shares.read_bytes())["pictures"] == [scene.panoramas[scene.train[1]].name]


def test_the_share_is_that_of_the_sphere() -> None:
    cells = np.zeros(CELLS, np.bool_)
    assert moving_share(None) == moving_share(cells) == 0
    cells[4:] = True
    assert moving_share(cells) == pytest.approx(0.5)
    pole = np.zeros(CELLS, np.bool_)
    pole[0] = True
    assert moving_share(pole) < 0.05
