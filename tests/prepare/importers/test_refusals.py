"""What is refused, and that the message says where and how to fix it."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from panolog.prepare.importers.import_scene import FORMATS, import_scene
from panolog.prepare.importers.interface import ImportSource
from panolog.scene.errors import InputError
from tests.prepare.importers.colmap_writers import panorama_sfm
from tests.prepare.importers.files import write_json
from tests.prepare.importers.writers import WRITERS, metashape, nerfstudio, openmvg, openmvg_parts


@pytest.mark.parametrize("name", ["../secret.png", "/../x", "a\0b", "x" * 2000, "", ".."])
def test_names_that_leave_the_folder(name: str, tmp_path: Path) -> None:
    known, source = openmvg(tmp_path / "source")
    parts = openmvg_parts(known)
    parts["views"][3]["value"]["ptr_wrapper"]["data"]["filename"] = name
    write_json(tmp_path / "source" / "sfm_data.json", parts)
    with pytest.raises(InputError, match=r"sfm_data\.json: views\[3\]\.value\.ptr_wrapper\.data\.filename"):
        FORMATS["openmvg"].read(source)


def test_errors_name_file_and_field(tmp_path: Path) -> None:
    known, source = openmvg(tmp_path / "source")
    path = tmp_path / "source" / "sfm_data.json"
    changes: list[tuple[Callable[[Any], Any], str]] = [
        (lambda p: p["extrinsics"][2]["value"]["center"].pop(), r"extrinsics\[2\]\.value\.center: 3 finite"),
        (lambda p: p["extrinsics"][2]["value"].pop("rotation"), r"extrinsics\[2\]\.value: has no 'rotation'"),
        (
            lambda p: p["extrinsics"][1]["value"]["rotation"][0].reverse(),
            r"extrinsics\[1\]\.value\.rotation: ",
        ),
        (lambda p: p.pop("views"), r"sfm_data\.json: has no 'views'"),
        (
            lambda p: p["intrinsics"][0]["value"].update(polymorphic_name="pinhole"),
            "its intrinsic is pinhole",
        ),
        (lambda p: p["views"][0]["value"]["ptr_wrapper"]["data"].update(width=100), r"views\[0\].*not 2:1"),
        (lambda p: p["structure"][5]["value"].update(X=[1, 2, "y"]), r"structure\[5\]\.value\.X: 3 "),
    ]
    for change, words in changes:
        parts = openmvg_parts(known)
        change(parts)
        write_json(path, parts)
        with pytest.raises(InputError, match=words):
            FORMATS["openmvg"].read(source)


@pytest.mark.parametrize("inside", [True, False])
def test_absolute_paths_among_relative_ones(tmp_path: Path, inside: bool) -> None:
    known, source = nerfstudio(tmp_path / "source")
    path = tmp_path / "source" / "transforms.json"
    content = json.loads(path.read_text())
    if not inside:
        (tmp_path / "source" / "images").rename(tmp_path / "elsewhere")
    folder = (tmp_path / "source" / "images") if inside else tmp_path / "elsewhere"
    content["frames"][1]["file_path"] = str(folder / known.names[1])
    content["train_filenames"] = [frame["file_path"] for frame in content["frames"][:2]]
    write_json(path, content)
    if inside:
        found = FORMATS["nerfstudio"].read(source)
        assert [image.name for image in found.images] == list(known.names)
        assert list(found.train) == [str(Path(name).with_suffix("")) for name in known.names[:2]]
        return
    with pytest.raises(InputError, match=r"frames\[1\]\.file_path: is absolute where others are relative"):
        FORMATS["nerfstudio"].read(source)


def test_a_mirror_is_no_pose(tmp_path: Path) -> None:
    known, source = nerfstudio(tmp_path / "source")
    path = tmp_path / "source" / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[0] *= -1
    write_json(path, content)
    with pytest.raises(InputError, match=r"frames\[0\]\.transform_matrix: mirrors"):
        FORMATS["nerfstudio"].read(source)
    assert known.width == 64


def test_wrong_sources(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    for wrong, option, words in (
        (ImportSource(tmp_path / "nowhere"), None, "there is no such file or folder"),
        (ImportSource(tmp_path), None, "of no format that can be imported; say which with --format"),
        (source, "colmapper", "--format colmapper: there is no such format; one of openmvg"),
        (ImportSource(source.path, images=tmp_path / "none"), None, "--images .*none: there is no such"),
        (
            ImportSource(source.path, points=tmp_path / "none.ply"),
            None,
            "--points .*none.ply: there is no such",
        ),
        (
            ImportSource(source.path, images=tmp_path),
            None,
            "pano_00.png is not in .*; say where the panoramas are",
        ),
    ):
        with pytest.raises(InputError, match=words):
            import_scene(wrong, tmp_path / "scene", format=option)
    with pytest.raises(InputError, match="already exists; give a new folder"):
        import_scene(source, tmp_path / "source")
    assert not (tmp_path / "scene").exists()


def test_a_colmap_model_of_other_cameras(tmp_path: Path) -> None:
    """Alone it is refused by its camera; next to another format it is ignored."""
    _, source = WRITERS["spheresfm"][1](tmp_path / "colmap")
    (source.path / "sparse" / "0" / "cameras.txt").write_text("1 OPENCV 64 32 1 1 1 1 0 0 0 0\n")
    with pytest.raises(
        InputError, match=r"cameras\.txt: line 1: `1 OPENCV .* is neither a panorama nor a pinhole"
    ):
        import_scene(source, tmp_path / "scene")
    _, source = nerfstudio(tmp_path / "colmap")
    assert import_scene(source, tmp_path / "scene").format == "nerfstudio"


def test_the_page_has_every_format() -> None:
    page = (Path(__file__).parents[3] / "docs" / "import.md").read_text(encoding="utf-8")
    for name in FORMATS:
        assert f"| `{name}` |" in page


def test_perspective_frames_are_no_panoramas(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    path = tmp_path / "source" / "transforms.json"
    content = json.loads(path.read_text())
    write_json(path, content | {"camera_model": "OPENCV"})
    with pytest.raises(
        InputError, match=r"transforms\.json: camera_model: the camera model is OPENCV; only EQUI"
    ):
        FORMATS["nerfstudio"].read(source)
    content["frames"][2]["camera_model"] = "OPENCV_FISHEYE"
    write_json(path, content)
    with pytest.raises(InputError, match=r"frames\[2\]\.camera_model: the camera model is OPENCV_FISHEYE"):
        FORMATS["nerfstudio"].read(source)


def test_metashape_in_geographic_coordinates(tmp_path: Path) -> None:
    _, source = metashape(tmp_path / "source")
    path = tmp_path / "source" / "cameras.xml"
    path.write_text(re.sub(r"(<translation[^>]*>)[^<]*", r"\g<1>4.1e6 8.5e5 4.8e6", path.read_text()))
    with pytest.raises(
        InputError, match="component 0: transform: leads to geocentric coordinates; set the chunk"
    ):
        FORMATS["metashape"].read(source)


def test_faces_that_are_no_rig(tmp_path: Path) -> None:
    _, source = panorama_sfm(tmp_path / "source")
    with pytest.raises(InputError, match="say where their panoramas are with --images"):
        FORMATS["panorama_sfm"].read(ImportSource(source.path))
    path = source.path / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    row = next(row for row, line in enumerate(lines) if "pano_camera7/pano_02.png" in line)
    words = lines[row].split()
    lines[row] = " ".join([*words[:5], "9", "9", "9", *words[8:]])
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"pano_02\.png: its faces disagree by .* units; map them as a rig"):
        FORMATS["panorama_sfm"].read(source)


def test_interrupted(tmp_path: Path) -> None:
    """Ctrl-C while images are copied leaves nothing behind."""

    def stop(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("import", 3):
            raise KeyboardInterrupt

    _, source = nerfstudio(tmp_path / "source")
    with pytest.raises(KeyboardInterrupt):
        import_scene(source, tmp_path / "scene", progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]
