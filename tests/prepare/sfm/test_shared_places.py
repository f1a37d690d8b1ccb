"""Structure from motion of the places in the shared data; a file of their own, because they take long."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.sfm import drift, length
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.data import shared

pytestmark = pytest.mark.system


def test_the_flat_comes_out_as_it_is_known(tmp_path: Path) -> None:
    given = shared("flat")
    made = _make(given / "images", tmp_path / "scene")
    known = read_scene(given)
    found = read_scene(tmp_path / "scene")
    assert [panorama.name for panorama in found.panoramas] == [panorama.name for panorama in known.panoramas]
    assert np.concatenate(made.found.model.errors(2048)).mean() < 0.6
    assert drift(found.centers, known.centers) < 0.01 * length(known.centers)


def test_the_school_yard_comes_together(tmp_path: Path) -> None:
    made = _make(shared("school") / "images", tmp_path / "scene")
    assert len(made.found.model.rows) == 4


def test_four_places_do_not(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="could not be connected"):
        _make(shared("unconnected") / "images", tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_the_long_street_holds_its_scale(tmp_path: Path) -> None:
    given = shared("street")
    (tmp_path / "alone").mkdir()
    (tmp_path / "alone" / "images").symlink_to(given / "images")
    made = _make(tmp_path / "alone", tmp_path / "scene")
    known = read_scene(given)
    assert len(made.found.model.rows) == 64
    assert drift(read_scene(tmp_path / "scene").centers, known.centers) < 0.005 * length(known.centers)


def _make(source: Path, output: Path) -> SfmReport:
    return make_scene(source, output, SfmSettings(), no_progress)
