"""Where a format has poses only, points come from the panoramas."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from panolog.prepare.importers.import_scene import import_scene
from panolog.prepare.importers.interface import ImportSource
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from tests.data import reduced, shared
from tests.prepare.importers.files import write_json
from tests.prepare.importers.writers import OPENGL, omniblender

pytestmark = pytest.mark.system


def _street(folder: Path, axes: np.ndarray, count: int) -> ImportSource:
    """The first panoramas of the street in OmniBlender's layout: poses only."""
    frames = []
    for panorama in read_scene(shared("street")).panoramas[:count]:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = panorama.rotation.T @ axes, panorama.center
        frames.append({"file_path": panorama.name, "transform_matrix": matrix.tolist()})
    write_json(folder / "transform.json", {"width": 640, "height": 320, "frames": frames})
    return ImportSource(folder, images=reduced("street", 640, folder.parent / "images", count))


def test_points_of_the_street(tmp_path: Path) -> None:
    report = import_scene(_street(tmp_path / "source", OPENGL, 6), tmp_path / "scene", link=True)
    assert "were triangulated" in report.notes[0]
    truth, scene = read_scene(shared("street")), read_scene(tmp_path / "scene")
    assert len(scene.points) > 200
    distance = cKDTree(truth.points).query(scene.points)[0]  # the true cloud is a sample of the surfaces
    assert np.median(distance) < 0.6
    assert min(len(panorama.observed) for panorama in scene.panoramas) > 50
    assert np.abs(scene.centers - truth.centers[:6]).max() < 1e-6


def test_poses_that_do_not_fit(tmp_path: Path) -> None:
    """Read as if they had y up, when they have not."""
    with pytest.raises(InputError, match=r"only \d+ could be triangulated: they do not fit the panoramas"):
        import_scene(_street(tmp_path / "source", np.eye(3), 4), tmp_path / "scene", link=True)
    assert {path.name for path in tmp_path.iterdir()} == {"source", "images"}


def test_panoramas_without_features(tmp_path: Path) -> None:
    _, source = omniblender(tmp_path / "source")
    with pytest.raises(InputError, match="has no points, and"):
        import_scene(ImportSource(source.path), tmp_path / "scene")
