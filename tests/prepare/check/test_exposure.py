"""Exposures before training: from points that panoramas share, from EXIF, and from how a walk continues."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.check import exposure
from panolog.prepare.check.exposure import Exposures, describe, differing_exposures, measure_exposures
from panolog.prepare.video.stamp import stamped
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.synthetic import make_town

Array = NDArray[np.float64]
STOPS = np.array([0.5, -0.5, 0.25, -0.25, 0.75, -0.75, 0.0, 0.0])  # of the panoramas, mean 0
ROWS = range(len(STOPS))
LONE = 4  # the panorama that may share no point


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("town") / "town"
    return read_scene(make_town(folder, panoramas=len(STOPS), width=256, points=2500))


def taken(
    street: Scene,
    folder: Path,
    stops: Array,
    *,
    exif: Sequence[float | None] | Array | None = None,
    name: str = "walk_{:03d}.jpg",
) -> Scene:
    """The street photographed with other exposures, in stops over the mean, and with EXIF that says these."""
    panoramas = []
    for row, (panorama, stop) in enumerate(zip(street.panoramas, stops, strict=True)):
        picture, factor = cv2.imread(str(panorama.image)), 2 ** (stop / 2.4)
        assert picture is not None
        shown = np.clip(picture * factor + 255 * 0.055 * (factor - 1), 0, 255).round().astype(np.uint8)
        jpeg = bytes(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 98])[1])
        said = None if exif is None else exif[row]
        path = folder / f"{row}.jpg"
        path.write_bytes(jpeg if said is None else stamped(jpeg, exposure=(0.01 * 2**said, 200)))
        panoramas.append(replace(panorama, name=name.format(row), image=path))
    return replace(street, panoramas=tuple(panoramas))


def apart(scene: Scene, rows: Sequence[int]) -> Scene:
    """The scene in which these panoramas share no point with any other."""
    panoramas, count = list(scene.panoramas), len(scene.points)
    own = {row: np.arange(number, count, 8) for number, row in enumerate(rows)}
    taken_by = np.concatenate(list(own.values()))
    for row, panorama in enumerate(panoramas):
        observed = own[row] if row in own else np.setdiff1d(panorama.observed, taken_by)
        panoramas[row] = replace(panorama, observed=observed)
    return replace(scene, panoramas=tuple(panoramas))


def stops_of(scene: Scene) -> np.ndarray:
    found = measure_exposures(scene, ROWS)
    assert found is not None
    return found.stops


def test_points_tell_exposures_without_exif(street: Scene, tmp_path: Path) -> None:
    assert stops_of(taken(street, tmp_path, STOPS)) == pytest.approx(STOPS, abs=0.05)


def test_exif_tells_exposures_where_no_points_are_shared(street: Scene, tmp_path: Path) -> None:
    scene = apart(taken(street, tmp_path, STOPS, exif=STOPS), ROWS)
    found = measure_exposures(scene, ROWS)
    assert found is not None
    assert found.stops == pytest.approx(STOPS, abs=0.01)
    assert np.abs(found.tints - 1).max() < 1e-9
    assert describe([panorama.name for panorama in scene.panoramas], found).endswith(", by EXIF alone")
    assert measure_exposures(apart(taken(street, tmp_path, STOPS), ROWS), ROWS) is None
    some = [*STOPS[:-1], None]
    assert measure_exposures(apart(taken(street, tmp_path, STOPS, exif=some), ROWS), ROWS) is None


def test_exif_tells_the_exposure_of_a_panorama_that_shares_no_points(street: Scene, tmp_path: Path) -> None:
    off = STOPS + np.array([0.1, -0.1, 0.1, -0.1, 0.0, -0.1, 0.1, 0.0])  # EXIF is not exact
    found = stops_of(apart(taken(street, tmp_path, STOPS, exif=off), [LONE]))
    assert found == pytest.approx(STOPS, abs=0.15)
    without = stops_of(apart(taken(street, tmp_path, STOPS), [LONE]))
    assert abs(without - STOPS)[LONE] > 0.5


def test_points_overrule_exif_that_is_wrong(street: Scene, tmp_path: Path) -> None:
    lies = -STOPS + np.array([0, 0, 2.0, 0, 0, 0, -1.0, 0])
    right = stops_of(taken(street, tmp_path, STOPS))
    assert stops_of(taken(street, tmp_path, STOPS, exif=lies)) == pytest.approx(right, abs=0.01)


def test_the_exposure_of_a_walk_goes_on_as_it_went(street: Scene, tmp_path: Path) -> None:
    """A frame that shares no points is between its neighbours, but not on the line between them."""
    bent = 1.2 * np.sin(np.linspace(0, np.pi, len(STOPS)))
    bent -= bent.mean()
    errors = {}
    for kind, name in {"frames": "walk_{:03d}.jpg", "stills": "{:03d} of the walk.jpg"}.items():
        found = stops_of(apart(taken(street, tmp_path, bent, name=name), [LONE]))
        errors[kind] = abs(found - bent)[LONE]
    assert errors["frames"] < 0.6 * errors["stills"]


def test_exposures_that_differ_are_measured_at_full_width(
    street: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = list[int]()

    def measure(scene: Scene, rows: Sequence[int], width: int) -> Exposures | None:
        measured.append(width)
        return measure_exposures(scene, rows, width)

    monkeypatch.setattr(exposure, "measure_exposures", measure)
    monkeypatch.setattr(exposure, "_QUICK", 128)
    scene = taken(street, tmp_path, STOPS)
    found, expected = differing_exposures(scene, ROWS), measure_exposures(scene, ROWS)
    assert found is not None and expected is not None
    assert np.array_equal(found.log_gain, expected.log_gain)
    monkeypatch.setattr(exposure, "DIFFERS", 1.0)
    assert differing_exposures(scene, ROWS) is None
    assert measured == [128, 256, 128]
