"""Exposure, orientation and crop of stills in every format, and how `scene sfm` takes them."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.world.cropped import complete_panoramas
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode_with_alpha
from tests.prepare.world.stills import SUFFIXES, crop, write_still

STOPS = math.log2(1 / 250 * 200 / 100 / 2.1**2)
FULL, PART = (128, 64), (96, 40)  # a panorama, and what of it is there from (16, 8) on
POSE: dict[str, float | str] = {"PoseHeadingDegrees": 225.5, "PosePitchDegrees": 3, "PoseRollDegrees": -2}
CROP = crop(FULL, 16, 8, PART)


def noise(size: tuple[int, int], seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(1, 256, (size[1], size[0], 3), np.uint8)


def completed(path: Path, folder: Path) -> Path:
    (found,) = complete_panoramas([PanoramaFile(path.parent, path.name, path)], folder)
    return found.path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_cropped_panorama_is_completed(tmp_path: Path, suffix: str) -> None:
    pixels = noise(PART)
    path = write_still(tmp_path / f"a{suffix}", pixels, panorama={**POSE, **CROP})
    whole = completed(path, tmp_path / "whole")
    assert whole == tmp_path / "whole" / "a.png"
    found, used = decode_with_alpha(whole)
    wanted = np.zeros((64, 128), bool)
    wanted[8:48, 16:112] = True
    assert used is not None
    np.testing.assert_array_equal(used, wanted)
    np.testing.assert_allclose(found[8:48, 16:112].astype(int), pixels, atol=0 if suffix != ".jpg" else 12)
    before, after = read_exif(path), read_exif(whole)
    assert (after.fix, after.time, after.attitude) == (before.fix, before.time, before.attitude)
    assert after.exposure_stops == pytest.approx(STOPS)
    assert (after.crop, after.orientation) == (None, 1)


def test_a_crop_that_was_scaled_is_completed_at_its_scale(tmp_path: Path) -> None:
    path = write_still(
        tmp_path / "a.png", noise(PART), panorama=crop((255, 128), 32, 15, (191, 80)), changed=None
    )
    found, used = decode_with_alpha(completed(path, tmp_path / "whole"))
    assert used is not None and found.shape == (64, 128, 3)
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (8, 47, 16, 111)


def test_what_is_transparent_in_a_crop_stays_so(tmp_path: Path) -> None:
    alpha = np.full((40, 96, 1), 255, np.uint8)
    alpha[-4:] = 0
    path = write_still(tmp_path / "a.png", np.dstack([noise(PART), alpha]), panorama=CROP)
    _, used = decode_with_alpha(completed(path, tmp_path / "whole"))
    assert used is not None and not used[44:].any() and used[8:44, 16:112].all()


def test_whole_panoramas_stay_as_they_are(tmp_path: Path) -> None:
    for name, panorama in (
        ("none.jpg", None),
        ("whole.jpg", crop(FULL, 0, 0, FULL)),
        ("stale.jpg", CROP),  # a program has completed it and left the entry
    ):
        path = write_still(tmp_path / name, noise(FULL), panorama=panorama)
        assert completed(path, tmp_path / "whole") == path
    assert not (tmp_path / "whole").exists()


@pytest.mark.parametrize(
    ("size", "panorama", "orientation", "message"),
    [
        (FULL, None, 6, r"EXIF orientation 6 turns or mirrors it"),
        (FULL, None, 2, r"exiftool -Orientation= FILE"),
        ((96, 60), CROP, None, r"96 x 60 pixels, but its GPano says 96 x 40 of 128 x 64"),
        (PART, crop((128, 80), 16, 8, PART), None, r"128 x 80 of a full panorama, which is not 2:1"),
        (PART, crop((2**20, 2**19), 0, 0, PART), None, r"more than any panorama has"),
    ],
)
def test_stills_that_cannot_be_used_are_one_clear_line(
    tmp_path: Path,
    size: tuple[int, int],
    panorama: dict[str, float | str] | None,
    orientation: int | None,
    message: str,
) -> None:
    path = write_still(tmp_path / "a.jpg", noise(size), panorama=panorama, orientation=orientation)
    with pytest.raises(InputError, match=message) as error:
        completed(path, tmp_path / "whole")
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    assert not (tmp_path / "whole").exists()


def test_a_damaged_crop_is_one_clear_line(tmp_path: Path) -> None:
    path = write_still(tmp_path / "a.png", noise(PART), panorama=CROP)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(InputError, match=r"a\.png: "):
        completed(path, tmp_path / "whole")
    assert not list(tmp_path.rglob("*.part"))


def test_sfm_reads_the_metadata_first(tmp_path: Path) -> None:
    for index in range(3):
        write_still(tmp_path / "place" / f"{index}.jpg", noise(FULL, index), orientation=3)
    with pytest.raises(InputError, match=r"0\.jpg: its EXIF orientation 3"):
        make_scene(tmp_path / "place", tmp_path / "scene", SfmSettings(), lambda *_: None)
