"""What a run folder says of movers: masks as a scene has them, shares, and pictures of the worst."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.orchestrator.engine.stages.movers import PICTURES, moving_share
from panolog.orchestrator.engine.stages.scenes import learnt_scene, save_captured
from panolog.orchestrator.runs.folder import RunFolder
from panolog.scene.images import load_view
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.capture.captured import Captured
from tests.scenes import write_scene

CELLS = 8, 16


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return read_scene(write_scene(tmp_path / "scene", names=[f"walk/{i:02d}.jpg" for i in range(20)]))


def captured(scene: Scene, sizes: dict[int, int]) -> Captured:
    """Movers of so many rows of cells from the horizon down, by row of the panorama."""
    movers = np.zeros((len(scene.train), *CELLS), np.bool_)
    for at, row in enumerate(scene.train):
        movers[at, 4 : 4 + sizes.get(row, 0), 2:6] = True
    return Captured(rows=np.array(scene.train, np.int64), movers=movers)


def test_masks_shares_and_pictures_of_the_worst(scene: Scene, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    sizes = {row: 1 + at % 3 for at, row in enumerate(scene.train[:12])}
    save_captured(folder, captured(scene, sizes), scene)
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
    scene: Scene, tmp_path: Path
) -> None:
    folder, row = RunFolder(tmp_path / "run"), scene.train[0]
    save_captured(folder, captured(scene, {row: 2}), scene)
    learnt, panorama = learnt_scene(folder, scene), scene.panoramas[row]
    for masked in (learnt.panoramas[row], replace(panorama, mask=folder.mover_mask(panorama.name))):
        view = load_view(masked, row, 64)
        assert view.mask is not None and not view.mask[16:24, 8:24].any() and view.mask[:12].all()
    assert all(learnt.panoramas[other].movers is None for other in (*scene.train[1:], *scene.test))


def test_a_photograph_that_is_gone_has_no_picture(scene: Scene, tmp_path: Path) -> None:
    folder, row = RunFolder(tmp_path / "run"), scene.train[0]
    scene.panoramas[row].image.unlink()
    save_captured(folder, captured(scene, {row: 2, scene.train[1]: 1}), scene)
    assert json.loads(folder.mover_shares.read_bytes())["pictures"] == [scene.panoramas[scene.train[1]].name]


def test_the_share_is_that_of_the_sphere() -> None:
    cells = np.zeros(CELLS, np.bool_)
    assert moving_share(None) == moving_share(cells) == 0
    cells[4:] = True
    assert moving_share(cells) == pytest.approx(0.5)
    pole = np.zeros(CELLS, np.bool_)
    pole[0] = True
    assert moving_share(pole) < 0.05
