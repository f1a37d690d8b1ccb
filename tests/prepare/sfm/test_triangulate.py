"""Where a format has poses only, points come from the panoramas."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from panolog.prepare.importers.import_scene import import_scene
from panolog.prepare.importers.interface import ImportSource
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from tests.prepare.importers.files import write_json
from tests.prepare.importers.writers import OPENGL
from tests.prepare.video.videos import DOWN, SIDE, UP, Shot, render, walk

pytestmark = pytest.mark.system

WIDTH = 512


def _street(folder: Path, shots: list[Shot], axes: np.ndarray) -> ImportSource:
    """A rendered street in OmniBlender's layout: poses only."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, shot in enumerate(shots):
        cv2.imwrite(str(folder / "images" / f"{number}.png"), render(shot, WIDTH))
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("YXZ", shot.turn, degrees=True).as_matrix() @ axes
        matrix[2, 3] = shot.along
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix.tolist()})
    write_json(folder / "transform.json", {"width": WIDTH, "height": WIDTH // 2, "frames": frames})
    return ImportSource(folder)


def test_points_of_the_street(tmp_path: Path) -> None:
    shots = walk([0.9] * 4)
    report = import_scene(_street(tmp_path / "source", shots, OPENGL), tmp_path / "scene", link=True)
    assert "were triangulated" in report.notes[0]
    scene = read_scene(tmp_path / "scene")
    assert len(scene.points) > 200
    x, y, _ = scene.points.T
    assert np.median(np.min([abs(abs(x) - SIDE), abs(y + UP), abs(y - DOWN)], axis=0)) < 0.1
    assert min(len(panorama.observed) for panorama in scene.panoramas) > 50
    assert np.abs(scene.centers - [[0, 0, shot.along] for shot in shots]).max() < 1e-6


def test_poses_that_do_not_fit(tmp_path: Path) -> None:
    """Read as if they had y up, when they have not."""
    source = _street(tmp_path / "source", walk([0.9] * 3), np.eye(3))
    with pytest.raises(InputError, match=r"only \d+ could be triangulated: they do not fit the panoramas"):
        import_scene(source, tmp_path / "scene", link=True)
    assert {path.name for path in tmp_path.iterdir()} == {"source"}


def test_panoramas_without_features(tmp_path: Path) -> None:
    source = _street(tmp_path / "source", walk([0.9] * 3), OPENGL)
    for path in (tmp_path / "source" / "images").iterdir():
        cv2.imwrite(str(path), np.full((64, 128), 90, np.uint8))
    with pytest.raises(InputError, match="has no points, and"):
        import_scene(source, tmp_path / "scene")
