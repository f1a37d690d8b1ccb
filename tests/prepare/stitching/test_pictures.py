"""Files of cameras of two lenses, and what `panolog scene stitch` makes of them."""

import json
import re
import shutil
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from panolog.prepare.stitching.circles import halves
from panolog.prepare.stitching.lenses import APPROXIMATE
from panolog.prepare.stitching.pictures import raw_pictures
from panolog.prepare.world.exif import camera_of, read_exif
from panolog.scene.image_files import decode_colors, read_info
from tests.orchestrator.cli.program import call, one_line, shown
from tests.prepare.stitching.cameras import camera
from tests.prepare.video.videos import Shot, render
from tests.prepare.world.stills import write_still

pytestmark = pytest.mark.system

Image = NDArray[np.uint8]


SIDE, WIDTH = 360, 800  # pixels of a lens's picture, and of the panoramas in it
INSTA = camera(SIDE)


@cache
def views(count: int = 2) -> list[Image]:
    return [render(Shot(7.3 * number), WIDTH, bearer=False) for number in range(count)]


def write_raw(folder: Path, pictures: list[Image], *, suffix: str = ".insp") -> list[Path]:
    """The pictures (H, W, 3) BGR as a camera writes them."""
    files = []
    for number, picture in enumerate(pictures):
        path = write_still(folder / f"IMG_{number}.jpg", np.ascontiguousarray(picture[..., ::-1]))
        files.append(path.rename(path.with_suffix(suffix)))
    return files


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Any]:
    """The folder of two pictures of an Insta360, that of their panoramas, and what is printed of them."""
    raw, out = tmp_path_factory.mktemp("raw"), tmp_path_factory.mktemp("made") / "out"
    write_raw(raw, [INSTA.picture(it, seed) for seed, it in enumerate(views())])
    return raw, out, shown("scene", "stitch", raw, "-o", out)


def test_a_folder_becomes_panoramas_that_know_what_their_pictures_know(
    place: tuple[Path, Path, Any],
) -> None:
    raw, out, printed = place
    assert (printed["panoramas"], printed["notes"]) == (2, [APPROXIMATE])
    assert printed["lenses"][0]["error_degrees"] < 0.1
    made = sorted(out.glob("*.jpg"))
    assert [it.name for it in made] == ["IMG_0.jpg", "IMG_1.jpg"]
    info, before, after = read_info(made[0]), read_exif(raw / "IMG_0.insp"), read_exif(made[0])
    assert info.width == 2 * info.height and 1.75 * SIDE < info.width < 2 * SIDE  # of both circles
    assert (after.fix, after.exposure_stops) == (before.fix, before.exposure_stops)
    assert after.time == before.time == datetime(2024, 5, 31, 12, 34, 56, 250_000)
    truth = cv2.resize(views()[0], (info.width, info.height), interpolation=cv2.INTER_AREA)
    assert np.abs(decode_colors(made[0]).astype(float) - truth).mean() < 12


def test_finished_ones_and_lenses_are_kept(place: tuple[Path, Path, Any], tmp_path: Path) -> None:
    raw, out = place[0], shutil.copytree(place[1], tmp_path / "out")
    lenses, states = (out / "lenses.json").read_bytes(), {it: it.stat() for it in out.glob("*.jpg")}
    (out / "IMG_1.jpg").unlink()
    shown("scene", "stitch", raw, "-o", out)
    assert (out / "lenses.json").read_bytes() == lenses
    same = [it.name for it, state in states.items() if it.stat().st_ctime_ns == state.st_ctime_ns]
    assert same == ["IMG_0.jpg"]
    before = decode_colors(out / "IMG_0.jpg")
    shown("scene", "stitch", raw, "-o", out, "--up", "right")
    assert json.loads((out / "lenses.json").read_bytes())[0]["up"] == "right"
    turned = decode_colors(out / "IMG_0.jpg")
    height, width = turned.shape[:2]
    # What was to the right of the middle, at a quarter of the width, is up now.
    assert np.abs(turned[2].mean(axis=0) - before[height // 2, 3 * width // 4]).max() < 40
    assert np.abs(turned.astype(float) - before).mean() > 20


def test_cameras_have_lenses_of_their_own_and_may_have_circles_above_each_other(tmp_path: Path) -> None:
    folder, other = tmp_path / "both", camera(400)
    write_raw(folder / "a", [INSTA.picture(it) for it in views()])
    write_raw(folder / "b", [np.vstack(halves(other.picture(it))) for it in views()], suffix=".jpg")
    assert len(raw_pictures(folder)) == 4
    printed = shown("scene", "stitch", folder, "-o", tmp_path / "out")
    assert [it["size"] for it in printed["lenses"]] == [[SIDE, SIDE], [400, 400]]
    assert camera_of(folder / "a" / "IMG_0.insp") == "RICOH"
    assert (tmp_path / "out" / "b" / "IMG_1.jpg").is_file()


def test_a_picture_whose_lenses_do_not_agree_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    pictures = [INSTA.picture(it, seed) for seed, it in enumerate(views(3))]
    write_raw(folder, [*pictures, camera(SIDE, tilt=2.6).picture(views()[0])])
    result = call("scene", "stitch", folder, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    (line,) = [it for it in result.stdout.splitlines() if "IMG_" in it]
    assert line.startswith("IMG_3.insp: the two lenses differ by")


CANNOT = r"IMG_0\.(insp|jpg): its two fisheye circles cannot be stitched: "


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("nothing", r"there is no such file or folder"),
        ("panoramas", r"shows no two fisheye circles next to each other; panoramas need no stitching"),
        ("one circle", r"shows no two fisheye circles"),
        ("cut off", CANNOT + r"its circle is cut off: it ends after 8\d% of .*; or stitch it in the"),
        ("no texture", CANNOT + "what both lenses show has too little texture: .*; or stitch it in the"),
        ("inside", r"is inside .*, whose pictures are read; give a folder elsewhere"),
        ("other files", r"has other files; give a new folder for the panoramas"),
    ],
)
def test_what_cannot_be_stitched_is_refused_in_one_line(case: str, said: str, tmp_path: Path) -> None:
    folder, out = tmp_path / "raw", tmp_path / "out"
    picture = INSTA.picture(views()[0])
    if case == "panoramas":
        picture = views()[0]
    elif case == "one circle":
        picture = halves(picture)[0]
    elif case == "cut off":
        picture = np.hstack([cv2.resize(it[27:-27, 27:-27], (SIDE, SIDE)) for it in halves(picture)])
    elif case == "no texture":
        picture = INSTA.picture(np.full((256, 512, 3), 140, np.uint8))
    if case != "nothing":
        write_raw(folder, [picture, picture], suffix=".insp" if case == "cut off" else ".jpg")
    if case == "other files":
        out.mkdir()
        (out / "notes.txt").touch()
    line = one_line(call("scene", "stitch", folder, "-o", folder / "out" if case == "inside" else out))
    assert re.search(said, line), line
    assert not list(tmp_path.rglob("lenses.json"))
