"""What is refused, and that the message says where and how to fix it."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from panolog.prepare.importers.import_scene import FORMATS, import_scene
from panolog.prepare.importers.interface import ImportSource
from panolog.scene.errors import InputError
from tests.prepare.importers.colmap_writers import panorama_sfm
from tests.prepare.importers.files import changed_json
from tests.prepare.importers.writers import WRITERS, metashape, nerfstudio

Change = Callable[[Any], object]  # of the content of a JSON file
_NAME, _SEEN = "views[3].value.ptr_wrapper.data.filename: ", "structure[4].value.observations"


def _named(name: str) -> Change:
    return lambda p: p["views"][3]["value"]["ptr_wrapper"]["data"].update(filename=name)


def _seen(**changes: object) -> Change:
    return lambda p: p["structure"][4]["value"]["observations"][0].update(changes)


def _mirrored(content: Any) -> None:
    for row in content["frames"][0]["transform_matrix"][:3]:
        row[0] *= -1


OPENMVG: list[tuple[Change, str]] = [
    *[(_named(it), f"{it[:80]!r} is not a path inside") for it in ("../secret.png", "a\0b", "x" * 2000)],
    (_named("/../x"), f"{_NAME}/../x is not in "),
    (_named(""), f"{_NAME}a text was expected"),
    (lambda p: p["extrinsics"][2]["value"]["center"].pop(), "extrinsics[2].value.center: 3 finite"),
    (lambda p: p["extrinsics"][2]["value"].pop("rotation"), "extrinsics[2].value: has no 'rotation'"),
    (lambda p: p["extrinsics"][1]["value"]["rotation"][0].reverse(), "extrinsics[1].value.rotation: "),
    (lambda p: p.pop("views"), "sfm_data.json: has no 'views'"),
    (lambda p: p["intrinsics"][0]["value"].update(polymorphic_name="pinhole"), "its intrinsic is pinhole"),
    (lambda p: p["views"][0]["value"]["ptr_wrapper"]["data"].update(width=100), "not 2:1"),
    (lambda p: p["structure"][5]["value"].update(X=[1, 2, "y"]), "structure[5].value.X: 3 "),
    (lambda p: p["structure"][4]["value"].update(observations=7), f"{_SEEN}: a list"),
    (_seen(key=-1), f"{_SEEN}[0].key: a whole number"),
    (_seen(value={"x": [1, 1e300]}), f"{_SEEN}[0].value.x: 2 finite"),
    (_seen(value={}), f"{_SEEN}[0].value: has no 'x'"),
    (_seen(value=5), f"{_SEEN}[0].value: an object"),
]
NERFSTUDIO: list[tuple[Change, str]] = [
    (_mirrored, "frames[0].transform_matrix: mirrors"),
    (lambda p: p.update(camera_model="OPENCV"), "camera_model: the camera model is OPENCV; only EQUI"),
    (lambda p: p["frames"][2].update(camera_model="OPENCV"), "frames[2].camera_model: the camera model is O"),
    (lambda p: p["frames"][1].update(file_path="/x/pano_01.png"), "frames[1].file_path: is absolute where"),
    (lambda p: p.update(ply_file_path="/x/sparse_pc.ply"), "ply_file_path: leaves the folder of the file"),
    (
        lambda p: p.update(ply_file_path="gone.ply"),
        "ply_file_path: there is no such file; give the cloud with",
    ),
]


@pytest.mark.parametrize(
    ("case", "change", "words"),
    [*[("openmvg", *it) for it in OPENMVG], *[("nerfstudio", *it) for it in NERFSTUDIO]],
)
def test_errors_name_file_and_field(case: str, change: Change, words: str, tmp_path: Path) -> None:
    """Also where names leave the folder."""
    _, source = WRITERS[case][1](tmp_path)
    (path,) = tmp_path.glob("*.json")
    with changed_json(path) as content:
        change(content)
    with pytest.raises(InputError, match=re.escape(words)) as error:
        FORMATS[case].read(source)
    assert str(error.value).startswith(f"{path}: ")


def test_absolute_paths_among_relative_ones(tmp_path: Path) -> None:
    known, source = nerfstudio(tmp_path)
    with changed_json(tmp_path / "transforms.json") as content:
        content["frames"][1]["file_path"] = str(tmp_path / "images" / known.names[1])
        content["train_filenames"] = [frame["file_path"] for frame in content["frames"][:2]]
        content["ply_file_path"] = str(tmp_path / content["ply_file_path"])
    found = FORMATS["nerfstudio"].read(source)
    assert [image.name for image in found.images] == list(known.names)
    assert len(found.points) == len(known.points)
    assert list(found.train) == [str(Path(name).with_suffix("")) for name in known.names[:2]]


def test_wrong_sources(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    for wrong, option, words in (
        (ImportSource(tmp_path / "nowhere"), None, "there is no such file or folder"),
        (ImportSource(tmp_path), None, "of no format that can be imported; say which with --format"),
        (source, "colmapper", "--format colmapper: there is no such format; one of openmvg"),
        (ImportSource(source.path, images=tmp_path / "none"), None, "--images .*none: there is no such"),
        (ImportSource(source.path, points=tmp_path / "a.ply"), None, "--points .*a.ply: there is no such"),
        (ImportSource(source.path, images=tmp_path), None, "pano_00.png is not in .*; say where the pano"),
    ):
        with pytest.raises(InputError, match=words):
            import_scene(wrong, tmp_path / "scene", format=option)
    with pytest.raises(InputError, match="already exists; give a new folder"):
        import_scene(source, tmp_path / "source")
    assert not (tmp_path / "scene").exists()


def test_a_colmap_model_of_other_cameras(tmp_path: Path) -> None:
    """Alone it is refused by its camera; next to another format it is ignored."""
    _, source = WRITERS["spheresfm"][1](tmp_path / "colmap")
    (source.path / "sparse" / "0" / "cameras.txt").write_text("0 OPENCV 64 32 1 1 1 1 0 0 0 0\n")
    with pytest.raises(InputError, match=r"camera 0 \(OPENCV, 64 x 32\) is neither a panorama nor a pinhole"):
        import_scene(source, tmp_path / "scene")
    _, source = nerfstudio(tmp_path / "colmap")
    assert import_scene(source, tmp_path / "scene").format == "nerfstudio"


def test_the_page_has_every_format() -> None:
    page = (Path(__file__).parents[3] / "docs" / "import.md").read_text(encoding="utf-8")
    for name in FORMATS:
        assert f"| `{name}` |" in page


def test_metashape_in_geographic_coordinates(tmp_path: Path) -> None:
    _, source = metashape(tmp_path / "source")
    path = tmp_path / "source" / "cameras.xml"
    path.write_text(re.sub(r"(<translation[^>]*>)[^<]*", r"\g<1>4.1e6 8.5e5 4.8e6", path.read_text()))
    with pytest.raises(
        InputError, match="component 0: transform: leads to geocentric coordinates; set the chunk"
    ):
        FORMATS["metashape"].read(source)


def test_a_folder_that_was_searched_is_named_once(tmp_path: Path) -> None:
    _, source = nerfstudio(tmp_path / "source")
    next((tmp_path / "source" / "images").iterdir()).unlink()
    with pytest.raises(InputError, match="is not in ") as refused:
        FORMATS["nerfstudio"].read(source)
    folders = str(refused.value).partition(" is not in ")[2].partition(";")[0].split(" or ")
    assert len(folders) == len(set(folders))


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
