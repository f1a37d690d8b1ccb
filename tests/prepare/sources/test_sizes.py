"""Panoramas of several sizes, and pictures that are nearly 2:1."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sources.sizes import to_one_size
from panolog.prepare.world.exif import read_exif
from panolog.scene.errors import InputError
from panolog.scene.image_files import decode_with_alpha, read_info
from tests.prepare.world.stills import write_still

POSE: dict[str, float | str] = {"PoseHeadingDegrees": 225.5, "PosePitchDegrees": 3, "PoseRollDegrees": -2}


def smooth(width: int, height: int) -> np.ndarray:
    """(height, width, 3) colours that change slowly, so that scaling hardly changes them."""
    v, u = np.mgrid[:height, :width] + 0.5
    waves = [np.cos(2 * np.pi * u / width), np.sin(np.pi * v / height), np.sin(2 * np.pi * u / width)]
    return np.stack([128 + 100 * it for it in waves], axis=-1).astype(np.uint8)


def sized(folder: Path, *names: str, notes: list[str] | None = None) -> list[PanoramaFile]:
    given = [PanoramaFile(folder, name, folder / name, "of") for name in names]
    return list(to_one_size(given, folder / "sized", note=(notes if notes is not None else []).append))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_smaller_panoramas_are_enlarged_and_keep_what_their_files_say(suffix: str, tmp_path: Path) -> None:
    write_still(tmp_path / "large.jpg", smooth(256, 128))
    path = write_still(tmp_path / f"a{suffix}", smooth(128, 64), panorama=POSE)
    notes = list[str]()
    small, large = sized(tmp_path, path.name, "large.jpg", notes=notes)
    assert large.path == tmp_path / "large.jpg"
    assert small.name == ("a.jpg" if suffix == ".jpg" else "a.png") and small.source == "of"
    assert (info := read_info(small.path)) and (info.width, info.height) == (256, 128)
    before, after = read_exif(path), read_exif(small.path)
    assert (after.fix, after.time, after.attitude) == (before.fix, before.time, before.attitude)
    assert after.time is not None and after.exposure_stops == pytest.approx(before.exposure_stops)
    found, _ = decode_with_alpha(small.path)
    off = np.abs(found.astype(int) - smooth(256, 128))
    assert off.mean() < 3
    assert notes == [f"1 panorama (a{suffix}) of another size than 256 x 128: scaled to it"]


def test_a_picture_that_lacks_a_row_is_stretched(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), smooth(256, 127))
    cv2.imwrite(str(tmp_path / "b.png"), smooth(255, 128))
    for picture in sized(tmp_path, "a.png", "b.png"):
        info = read_info(picture.path)
        assert (info.width, info.height) == (256, 128)


def test_what_is_transparent_stays_so(tmp_path: Path) -> None:
    alpha = np.full((64, 128, 1), 255, np.uint8)
    alpha[48:] = 0
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([smooth(128, 64), alpha]))
    cv2.imwrite(str(tmp_path / "b.png"), smooth(256, 128))
    small, _ = sized(tmp_path, "a.png", "b.png")
    _, used = decode_with_alpha(small.path)
    assert used is not None and used[:94].all() and not used[96:].any()


def test_an_enlarged_panorama_is_made_once_for_each_state_of_its_source(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), smooth(128, 64))
    cv2.imwrite(str(tmp_path / "b.png"), smooth(256, 128))
    before = sized(tmp_path, "a.png", "b.png")[0].path.stat().st_ino
    assert sized(tmp_path, "a.png", "b.png")[0].path.stat().st_ino == before
    os.utime(tmp_path / "a.png", ns=(1, 1))
    changed = sized(tmp_path, "a.png", "b.png")[0].path.stat().st_ino
    assert changed != before
    cv2.imwrite(str(tmp_path / "b.png"), smooth(300, 150))
    assert read_info(sized(tmp_path, "a.png", "b.png")[0].path).width == 300


@pytest.mark.parametrize(
    ("size", "words"),
    [((256, 124), "256 x 124 pixels are not 2:1"), ((32, 16), "is 32 pixels wide, and b.png 256")],
)
def test_what_is_no_panorama_of_the_place_is_refused(
    size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), smooth(*size))
    cv2.imwrite(str(tmp_path / "b.png"), smooth(256, 128))
    with pytest.raises(InputError, match=f"a.png: {words}"):
        sized(tmp_path, "a.png", "b.png")
