"""What a source has besides poses and points is imported, or the report says that it was left out."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from panolog.prepare.importers.import_scene import import_scene
from panolog.prepare.importers.interface import ImportSource
from panolog.scene.errors import InputError
from panolog.scene.images import load_view
from panolog.scene.read import read_scene
from panolog.scene.write import read_offset
from tests.prepare.importers.files import changed_json, write_json
from tests.prepare.importers.known import Known
from tests.prepare.importers.writers import WRITERS, metashape, nerfstudio, opensfm
from tests.scenes import HEIGHT, WIDTH

MASK = np.where(np.arange(HEIGHT) < HEIGHT - 5, 255, 0).astype(np.uint8)[:, None].repeat(WIDTH, 1)


def write_mask(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), MASK)


def name_masks(folder: Path, known: Known, pattern: str) -> None:
    """A path of a mask in each frame of a transforms.json."""
    with changed_json(folder / "transforms.json") as content:
        for frame, name in zip(content["frames"], known.names, strict=True):
            frame["mask_path"] = pattern.format(stem=Path(name).stem)
            write_mask(folder / frame["mask_path"])


CASES: list[tuple[str, str]] = [
    ("nerfstudio", "named"),
    ("nerfstudio", "masks/{stem}.png"),
    ("spheresfm", "masks/{name}.png"),
    ("opensfm", "masks/{name}.png"),
    ("metashape", "masks/{stem}_mask.png"),
    ("openmvg", "images/{name}_mask.png"),
    ("omnigs", "images/{stem}_mask.png"),
    ("egonerf", "masks/{stem}.jpg"),
    ("panorama_sfm", "masks/{stem}.png"),
    ("360roam", "mask/{stem}.png"),
    ("omniblender", "masks/{stem}.png"),
]


@pytest.mark.parametrize(("case", "pattern"), CASES, ids=lambda it: str(it).replace("/", " "))
def test_masks_are_imported(case: str, pattern: str, tmp_path: Path) -> None:
    """They were dropped without a word, and the operator was trained."""
    known, source = WRITERS[case][1](tmp_path / "source")
    if pattern == "named":
        name_masks(source.path, known, "ignore/m_{stem}.png")
    for name in () if pattern == "named" else known.names:
        write_mask(source.path / pattern.format(name=name, stem=Path(name).stem))
    report = import_scene(source, tmp_path / "scene")
    assert "6 of 6 panoramas have a mask in the source" in "; ".join(report.notes)
    scene = read_scene(tmp_path / "scene")
    for row, panorama in enumerate(scene.panoramas):
        mask = load_view(panorama, row, WIDTH).mask
        assert mask is not None
        assert np.array_equal(mask.numpy(), MASK > 0)


def test_a_mask_is_not_that_of_two_panoramas(tmp_path: Path) -> None:
    """Cameras name files alike in each folder: without the folder a mask is of one of them, but of which?"""
    _, source = nerfstudio(tmp_path / "source")
    with changed_json(source.path / "transforms.json") as content:
        for number, frame in enumerate(content["frames"]):
            path = source.path / f"images/day{number % 2}/{number // 2}.png"
            path.parent.mkdir(exist_ok=True)
            (source.path / frame["file_path"]).rename(path)
            frame["file_path"] = str(path.relative_to(source.path))
    write_mask(source.path / "masks" / "0.png")
    write_mask(source.path / "masks" / "day1" / "1.png")
    notes = import_scene(source, tmp_path / "scene").notes
    assert "1 of 6 panoramas have a mask in the source" in notes[0]
    assert "masks: 1 file (0.png): left out" in notes[1]
    masks = {panorama.name: panorama.mask for panorama in read_scene(tmp_path / "scene").panoramas}
    assert [name for name, mask in masks.items() if mask] == ["day1/1.png"]


def test_masks_that_belong_to_no_panorama_are_named(tmp_path: Path) -> None:
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    for name in ("pano_00.TIF", "left.png", "right.png", "a.png", "b.png"):
        write_mask(source.path / "masks" / name)
    (source.path / "depths").mkdir()
    (source.path / "offset.json").touch()
    write_mask(source.path / "images" / "mask.png")
    notes = import_scene(source, tmp_path / "scene").notes
    assert "1 of 6 panoramas have a mask in the source" in notes[0]
    lost = "masks: 4 files (a.png, b.png, left.png, …): left out, as masks of no panorama"
    assert lost in notes[1]
    assert "images/mask.png: left out; if black in it is to be ignored in all panoramas" in notes[2]
    assert "depths: left out; `panolog scene depth` makes depth maps" in notes[3]
    assert "offset.json: left out; copy it to SCENE" in notes[4]
    assert len(notes) == 5


def test_a_damaged_mask_is_refused_by_its_name(tmp_path: Path) -> None:
    known, source = opensfm(tmp_path / "source")
    path = source.path / "masks" / f"{known.names[2]}.png"
    write_mask(path)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=rf"source/masks/{known.names[2]}\.png: the image is truncated"):
        import_scene(source, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("masks/none.png", "there is no such mask"),
        ("../secret.png", "there is no such mask"),
        (5, "a text was"),
    ],
)
def test_masks_that_a_file_names_wrongly(entry: object, words: str, tmp_path: Path) -> None:
    write_mask(tmp_path / "secret.png")
    _, source = nerfstudio(tmp_path / "source")
    with changed_json(source.path / "transforms.json") as content:
        content["mask_path"] = entry
    with pytest.raises(InputError, match=f"transforms.json: mask_path: {words}"):
        import_scene(source, tmp_path / "scene")


def test_nerfstudio_without_what_others_write(tmp_path: Path) -> None:
    """No camera model, no entry for the cloud, maps of depth: each is in the report."""
    known, source = nerfstudio(tmp_path / "source")
    (source.path / "sparse_pc.ply").rename(source.path / "pointcloud.ply")
    with changed_json(source.path / "transforms.json") as content:
        del content["camera_model"], content["ply_file_path"]
        for frame in content["frames"][:2]:
            frame["depth_file_path"] = "depths/x.png"
        content["train_filenames"] = [frame["file_path"] for frame in content["frames"]]
    report = import_scene(source, tmp_path / "scene")
    assert report.points == len(known.points)
    assert "no camera_model: taken to be EQUIRECTANGULAR" in report.notes[0]
    assert "2 depth maps are left out" in report.notes[1]
    assert "the source's split is left out" in report.notes[-1]
    with changed_json(source.path / "transforms.json") as content:
        content["camera_angle_x"] = 0.7
    with pytest.raises(InputError, match="camera_angle_x: a camera with a field of view"):
        import_scene(source, tmp_path / "other")


Split = tuple[dict[str, str], tuple[int, ...], str]  # files with numbers of panoramas; the test split, a note
SPLITS: list[Split] = [
    ({"train": "0 1 2 3", "test": "4 5"}, (4, 5), ""),
    ({"train": "0 1 2", "test": "4"}, (4,), "2 panoramas (pano_03, pano_05): not used"),
    ({"test": "4 5"}, (4, 5), ""),
    ({"train": "0 1 2 3"}, (4, 5), ""),
    ({"test": "4 7 8"}, (4,), "2 names (pano_07, pano_08) of the source's split: left out"),
    ({"test": "7"}, (0,), "the source's split is left out"),
    ({"train": "0 1 2", "test": "2 3"}, (0,), "the source's split is left out"),
]
FORMATS = ["spheresfm", "opensfm", "metashape", "openmvg", "nerfstudio"]


@pytest.mark.parametrize(
    ("case", "split"), [*(("poses", split) for split in SPLITS), *((case, SPLITS[1]) for case in FORMATS)]
)
def test_the_split_next_to_any_source(case: str, split: Split, tmp_path: Path) -> None:
    """Most formats dropped a split without a note, and names that no panorama has with it."""
    files, test, note = split
    _, source = WRITERS[case][1](tmp_path / "source")
    for name, numbers in files.items():
        lines = [f"pano_0{number}.png\n" for number in numbers.split()]
        (source.folder / f"{name}.txt").write_text("".join(lines))
    report = import_scene(source, tmp_path / "scene")
    assert note in "; ".join(report.notes)
    assert bool(note) == ("split" in "; ".join(report.notes))
    assert read_scene(tmp_path / "scene").test == test


def test_names_in_the_split_of_a_file(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    with changed_json(source.path / "transforms.json") as content:
        paths = [frame["file_path"] for frame in content["frames"]]
        content |= {"train_filenames": [*paths[:4], "images/lost.png"], "test_filenames": paths[4:]}
    notes = import_scene(source, tmp_path / "scene").notes
    assert "1 name (images/lost) of the source's split: left out, as of no panorama" in notes
    assert read_scene(tmp_path / "scene").test == (4, 5)


def change_metashape(folder: Path, change: Callable[[str], str]) -> ImportSource:
    _, source = metashape(folder)
    path = folder / "cameras.xml"
    path.write_text(change(path.read_text()))
    return source


def test_disabled_cameras_are_left_out_and_named(tmp_path: Path) -> None:
    def disable(text: str) -> str:
        for name, word in (("pano_02", "false"), ("pano_03", "0"), ("pano_04", "true")):
            text = text.replace(f'label="{name}"', f'label="{name}" enabled="{word}"')
        return text

    source = change_metashape(tmp_path / "source", disable)
    report = import_scene(source, tmp_path / "scene")
    assert report.panoramas == 4
    assert "2 cameras (pano_02, pano_03): left out, as they are disabled" in report.notes


@pytest.mark.parametrize("placed", [True, False])
def test_components_share_a_world_only_if_they_have_a_place(placed: bool, tmp_path: Path) -> None:
    """Two worlds used to be mixed in one scene."""

    def split(text: str) -> str:
        for index in (0, 1):
            text = text.replace(
                f'camera id="{index}" sensor_id="3" component_id="0"',
                f'camera id="{index}" sensor_id="3" component_id="1"',
            )
        begin, end = text.index("<component "), text.index("</components>")
        component = text[begin:end]
        if not placed:
            component = '<component id="0" label="Component 1"></component>'
        return text[:begin] + component + component.replace('id="0"', 'id="1"') + text[end:]

    report = import_scene(change_metashape(tmp_path / "source", split), tmp_path / "scene")
    assert report.panoramas == (6 if placed else 4)
    lost = "2 cameras (pano_00, pano_01): left out, as they are in component 1, which nothing connects"
    assert (lost in "; ".join(report.notes)) != placed


def test_the_place_of_opensfm(tmp_path: Path) -> None:
    _, source = opensfm(tmp_path / "source")
    place = {"latitude": 47.3, "longitude": 8.5, "altitude": 0.0}
    write_json(source.path / "reference_lla.json", place)
    import_scene(source, tmp_path / "scene")
    found = read_offset(tmp_path / "scene")
    assert found is not None and found.origin is not None
    assert (found.frame, found.offset, found.origin.model_dump()) == ("ENU", (0, 0, 0), place)
    write_json(source.path / "reference_lla.json", dict.fromkeys(place, 0.0))  # no GPS
    import_scene(source, tmp_path / "without")
    assert read_offset(tmp_path / "without") is None
    write_json(source.path / "reference_lla.json", place | {"latitude": 100})
    with pytest.raises(InputError, match=r"reference_lla\.json: is no place on the earth"):
        import_scene(source, tmp_path / "nowhere")


@pytest.mark.parametrize("where", ["sparse_equirectangular/0", "colmap/sparse/0"])
def test_models_where_others_put_them(where: str, tmp_path: Path) -> None:
    _, source = WRITERS["spheresfm"][1](tmp_path / "source")
    (source.path / where).parent.mkdir(parents=True)
    (source.path / "sparse" / "0").rename(source.path / where)
    (source.path / "sparse").rmdir()
    assert import_scene(source, tmp_path / "scene").panoramas == 6
    assert len(read_scene(source.path).panoramas) == 6  # and it is a scene itself
