"""Structure from motion of the places in the shared data; a file of their own, because they take long."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.sfm import drift, length
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.data import shared

pytestmark = pytest.mark.system


def test_the_flat_comes_out_as_it_is_known(tmp_path: Path) -> None:
    known = read_scene(shared("flat"))
    made = _make("flat", 1024, tmp_path)
    found = read_scene(tmp_path / "scene")
    assert [panorama.name for panorama in found.panoramas] == [panorama.name for panorama in known.panoramas]
    assert np.concatenate(made.found.model.errors(1024)).mean() < 0.6
    assert drift(found.centers, known.centers) < 0.01 * length(known.centers)


def test_the_school_yard_comes_together(tmp_path: Path) -> None:
    made = _make("school", 1024, tmp_path)
    assert len(made.found.model.rows) == 4


def test_the_long_street_holds_its_scale(tmp_path: Path) -> None:
    known = read_scene(shared("street"))
    made = _make("street", 640, tmp_path)
    assert len(made.found.model.rows) == 64
    assert drift(read_scene(tmp_path / "scene").centers, known.centers) < 0.005 * length(known.centers)


def _make(place: str, width: int, folder: Path) -> SfmReport:
    """A scene of the panoramas of a place, reduced to a width: a third of the time, and as good."""
    (folder / "images").mkdir()
    for path in sorted((shared(place) / "images").iterdir()):
        picture = cv2.imread(str(path))
        assert picture is not None
        small = cv2.resize(picture, (width, width // 2), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / "images" / path.name), small, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return make_scene(folder / "images", folder / "scene", SfmSettings(), no_progress)
