"""What panoramas are taken from: folders with layers, and what is refused in one line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sources.find import find_sources
from panolog.prepare.sources.gather import gather, panoramas_in_folder, without_copies
from panolog.scene.errors import InputError
from panolog.scene.write import no_progress


def _pictures(folder: Path, *shapes: tuple[int, int]) -> None:
    folder.mkdir(parents=True)
    for number, shape in enumerate(shapes or [(64, 128)] * 3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full(shape, 90 + number, np.uint8))


@pytest.mark.parametrize(
    "what, message",
    [
        ("nothing", "there is no such folder or video"),
        ("one", "1 panoramas .*; at least 3 are needed"),
        ("two", "2 panoramas .*; at least 3 are needed"),  # which no scene can have: one is held out
        ("sizes", r"1\.png: is 16 pixels wide, and 0\.png 128, more than 4 times as many; leave it out"),
        ("another format", r"1\.png: COLMAP cannot read this image; save it as"),
        ("taken", "already exists"),
        ("inside", "give a folder elsewhere"),
    ],
)
def test_refusals(what: str, message: str, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    output = (folder if what == "inside" else tmp_path) / "scene"
    shapes = {"one": [(64, 128)], "two": [(64, 128)] * 2, "sizes": [(64, 128), (8, 16), (8, 16)]}
    if what != "nothing":
        _pictures(folder, *shapes.get(what, []))
    if what == "another format":
        (folder / "1.png").write_bytes(bytes(cv2.imencode(".webp", np.full((64, 128), 90, np.uint8))[1]))
    if what == "taken":
        output.mkdir()
        (output / "mine").touch()
    with pytest.raises(InputError, match=message):
        make_scene(folder, output, SfmSettings(), no_progress)
    assert sorted(path.name for path in output.rglob("*")) == (["mine"] if what == "taken" else [])


def test_copies_are_left_out_by_content_and_named(tmp_path: Path) -> None:
    _pictures(tmp_path / "images", *[(64, 128)] * 3)
    (tmp_path / "masks").mkdir()
    for name in ("0", "2"):
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), np.full((64, 128), 255, np.uint8))
    (tmp_path / "images" / "3.png").write_bytes((tmp_path / "images" / "1.png").read_bytes())
    panoramas, lines = without_copies(panoramas_in_folder(tmp_path))
    assert [panorama.name for panorama in panoramas] == ["0.png", "1.png", "2.png"]
    assert ["masks" in panorama.layers for panorama in panoramas] == [True, False, True]
    assert lines == ["3.png: is a copy of 1.png, left out"]


def test_copies_of_one_picture_are_refused(tmp_path: Path) -> None:
    _pictures(tmp_path / "images", *[(64, 128)] * 2)
    (tmp_path / "images" / "2.png").write_bytes((tmp_path / "images" / "0.png").read_bytes())
    with pytest.raises(InputError, match=r"2 panoramas differ, the others are copies; at least 3 are"):
        make_scene(tmp_path / "images", tmp_path / "scene", SfmSettings(), no_progress)


@pytest.mark.system
def test_pictures_of_nothing_are_refused(tmp_path: Path) -> None:
    _pictures(tmp_path / "images")
    with pytest.raises(InputError, match="no features"):
        make_scene(tmp_path / "images", tmp_path / "scene", SfmSettings(), no_progress)
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    "pictures, given", [("place/images", "place"), ("place/images", "place/images"), ("place", "place")]
)
def test_where_pictures_and_masks_are(pictures: str, given: str, tmp_path: Path) -> None:
    _pictures(tmp_path / pictures)
    _pictures(tmp_path / "place" / "masks")
    panoramas = panoramas_in_folder(tmp_path / given)
    assert [panorama.name for panorama in panoramas] == ["0.png", "1.png", "2.png"]
    masks = [tmp_path / "place" / "masks" / f"{number}.png" for number in range(3)]
    assert [panorama.layers for panorama in panoramas] == [{"masks": mask} for mask in masks]


def test_pictures_next_to_their_folder_are_named(tmp_path: Path) -> None:
    """The half of a place that was not in its folder images was missing without a word."""
    _pictures(tmp_path / "place")
    _pictures(tmp_path / "place" / "images")
    sources = find_sources([tmp_path / "place"])
    found = gather(sources, tmp_path / "work", SfmSettings(), no_progress)
    assert [panorama.path.parent.name for panorama in found.panoramas] == ["images"] * 3
    (line,) = found.left_out
    assert line.startswith("3 files (0.png, 1.png, 2.png): left out, as pictures are taken from ")


def test_a_mask_next_to_its_panorama_is_no_panorama(tmp_path: Path) -> None:
    """It was reconstructed as one more picture, and the operator was trained."""
    _pictures(tmp_path / "images")
    cv2.imwrite(str(tmp_path / "images" / "1_mask.png"), np.full((64, 128), 255, np.uint8))
    panoramas = panoramas_in_folder(tmp_path / "images")
    assert [panorama.name for panorama in panoramas] == ["0.png", "1.png", "2.png"]
    mask = tmp_path / "images" / "1_mask.png"
    assert [panorama.layers for panorama in panoramas] == [{}, {"masks": mask}, {}]


def test_what_is_left_out_is_in_the_refusal(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    _pictures(folder)
    (folder / "0.png").rename(folder / "0.insp")
    (folder / "2.jxl").touch()
    lines = (
        r"1 file \(0\.insp\): left out, each a photograph of two fisheye",
        r"1 file \(2\.jxl\): left out, each JPEG XL; convert it with `djxl",
    )
    words = "2 panoramas .*; at least 3 are needed; " + ".*; ".join(lines)
    with pytest.raises(InputError, match=words):
        panoramas_in_folder(folder)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((64, 128), "is no panorama, but shows two fisheye circles; stitch it"),
        ((128, 64), "512 x 1024 pixels are not 2:1: not a panorama; it shows two fisheye circles; stitch it"),
        ((64, 64), "512 x 512 pixels are not 2:1: not a panorama; it shows one fisheye circle; stitch it"),
    ],
)
def test_fisheye_circles_are_refused_by_name(
    shape: tuple[int, int], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses were found for two circles as if they were a panorama; one among six was 79 degrees off."""
    scale, folder = 8, tmp_path / "images"
    _pictures(folder, *[(64 * scale, 128 * scale)] * 3)
    height, width = (scale * size for size in shape)
    side = min(height, width)
    y, x = (np.mgrid[:height, :width] + 0.5) % side / side * 2 - 1
    circles = np.where(np.hypot(x, y) < 1, np.random.default_rng(0).integers(60, 255, (height, width)), 0)
    cv2.imwrite(str(folder / "1.png"), circles)
    monkeypatch.setattr("panolog.prepare.sfm.features.processes_for", lambda *_: 1)
    with pytest.raises(InputError, match=f"1.png: {words}"):
        make_scene(folder, tmp_path / "scene", SfmSettings(), no_progress)
