"""Figures are drawn where people would stand, the same for the same seed; the rest of a scene is linked."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.movers.figures import Figure, Standpoint, draw
from benchmarks.movers.paste import FIGURES, GROUP, chosen, paste
from panolog.scene.errors import SceneError
from panolog.scene.read import read_scene
from tests.scenes import write_scene


def test_a_figure_has_the_size_and_place_of_a_person() -> None:
    """Twice its height away, at the height of the eyes, to the right of a camera that looks forward."""
    looks = Figure.drawn(np.random.default_rng(1), 1.6)
    axes = np.array([[0, 0, -1.0], [0, -1, 0], [1, 0, 0]])  # forward is the camera's x
    picture = draw(looks, Standpoint(axes, 1.6, 2 * looks.stature), 512)
    rows, columns = np.nonzero(picture.cover > 0.5)
    assert columns.mean() == pytest.approx(384, abs=2)
    feet, head = (np.arctan2(height, 2 * looks.stature) for height in (1.6, 1.6 - looks.stature))
    assert rows.max() == pytest.approx(256 * (feet / np.pi + 0.5), abs=4)
    assert rows.min() == pytest.approx(256 * (head / np.pi + 0.5), abs=4)
    assert picture.distance[rows, columns] == pytest.approx(2 * looks.stature, rel=0.3)
    assert picture.light.min() == pytest.approx(0.5, abs=0.05) and picture.light[:128].min() == 1


def test_figures_are_in_a_share_of_the_training_panoramas_alone(tmp_path: Path) -> None:
    scene = read_scene(write_scene(tmp_path / "scene", names=[f"{i:02d}.jpg" for i in range(40)], points=500))
    crowd, again = tmp_path / "crowd" / "images", tmp_path / "again" / "images"
    covered = paste(scene, crowd.parent, 0.2, 3)
    assert len(covered) == round(0.2 * len(scene.train))
    assert covered.keys() <= {scene.panoramas[row].name for row in scene.train}
    assert {path.name for path in crowd.iterdir() if not path.is_symlink()} == set(covered)
    assert paste(scene, again.parent, 0.2, 3) == covered
    assert all((crowd / name).read_bytes() == (again / name).read_bytes() for name in covered)
    assert paste(scene, tmp_path / "other", 0.2, 4) != covered
    mask = cv2.imread(str(tmp_path / "crowd" / FIGURES / f"{Path(next(iter(covered))).stem}.png"), 0)
    assert mask is not None and (mask > 0).mean() == pytest.approx(next(iter(covered.values())))
    assert read_scene(tmp_path / "crowd").train == scene.train
    with pytest.raises(SceneError, match="already exists"):
        paste(scene, tmp_path / "crowd", 0.2, 3)


def test_some_panoramas_with_figures_follow_each_other() -> None:
    train = tuple(range(0, 120, 2))
    groups = chosen(train, 0.2, np.random.default_rng(0))
    rows = [row for group in groups for row in group]
    assert len(rows) == len(set(rows)) == 12
    assert sorted(map(len, groups))[-2:] == [GROUP, GROUP]
    assert all(group == list(train[train.index(group[0]) :][: len(group)]) for group in groups)
