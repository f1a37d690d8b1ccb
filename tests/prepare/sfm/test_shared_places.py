"""Structure from motion of the places in the shared data."""

from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.data import reduced, shared
from tests.prepare.sfm.accuracy import drift, length

pytestmark = pytest.mark.nightly


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
    known = read_scene(shared("street")).centers[:40]
    made = _make("street", 640, tmp_path, 40)
    assert len(made.found.model.rows) == 40
    assert drift(read_scene(tmp_path / "scene").centers, known) < 0.005 * length(known)


def _make(place: str, width: int, folder: Path, count: int | None = None) -> SfmReport:
    images = reduced(place, width, folder / "images", count)
    return make_scene(images, folder / "scene", SfmSettings(), no_progress)
