"""Structure from motion of the places in the shared data."""

from pathlib import Path

import numpy as np
import pytest

from panolog.prepare.sfm.joining.join import join_scene
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


def test_the_other_half_of_the_street_joins_the_first(tmp_path: Path) -> None:
    known = {panorama.stem: panorama.center for panorama in read_scene(shared("street")).panoramas}
    images, more = reduced("street", 640, tmp_path / "images", 24), tmp_path / "more"
    more.mkdir()
    for path in sorted(images.iterdir())[1::2]:
        path.rename(more / path.name)
    make_scene(images, tmp_path / "scene", SfmSettings(), no_progress)
    report = join_scene([more], tmp_path / "scene", tmp_path / "both", SfmSettings(), no_progress)
    assert report.as_json()["into"]["joined"] == 12 and report.found.contradictions == []
    first, both = read_scene(tmp_path / "scene"), read_scene(tmp_path / "both")
    named = {panorama.name: panorama for panorama in both.panoramas}
    for one in first.panoramas:
        same = named[one.name]
        assert np.array_equal(one.rotation, same.rotation)
        assert np.array_equal(one.translation, same.translation)
    truth = np.stack([known[Path(panorama.name).stem] for panorama in both.panoramas])
    assert drift(both.centers, truth) < 0.003 * length(np.stack(list(known.values()))[:24])
    count = len(first.points)
    assert len(both.points) > 1.5 * count and np.array_equal(both.points[:count], first.points)


def _make(place: str, width: int, folder: Path, count: int | None = None) -> SfmReport:
    images = reduced(place, width, folder / "images", count)
    return make_scene(images, folder / "scene", SfmSettings(), no_progress)
