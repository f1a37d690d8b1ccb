import errno
import json
import os
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import plyfile
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image

from panolog.orchestrator.runs.folder import RunFolder
from panolog.prepare.panorama_files import list_posed_panoramas
from panolog.prepare.provenance import png_with_provenance
from panolog.scene.errors import InputError
from panolog.scene.images import load_layers
from panolog.scene.model import Scene
from panolog.scene.read import check_names, read_scene, read_split
from tests.scene.test_colmap import as_text
from tests.scenes import write_image, write_scene

GREY = np.full((32, 64), 200, np.uint8)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


def add(root: Path, layer: str, name: str, pixels: NDArray[Any]) -> None:
    path = root / layer / name
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)


def as_pano360(root: Path) -> None:
    """The layout of the paper's authors: imgs, text, a dummy pinhole, the cloud as PLY alone."""
    (root / "images").rename(root / "imgs")
    folder = root / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(folder))
    as_text(folder)
    (folder / "cameras.txt").write_text("1 PINHOLE 64 32 64 32 32 16\n")
    points = [reconstruction.points3D[key] for key in sorted(reconstruction.points3D)]
    rows = np.array(
        [(*p.xyz, 0, 0, 0, *p.color) for p in points],
        [(c, "f8") for c in "xyz"]
        + [(f"n{c}", "f4") for c in "xyz"]
        + [(c, "u1") for c in ("red", "green", "blue")],
    )
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(folder / "points3D.ply")
    (folder / "points3D.txt").write_text("# no points here\n")
    lines = (folder / "images.txt").read_text().splitlines()
    poses = [line for line in lines if line.endswith("jpg")]
    (folder / "images.txt").write_text("".join(f"{pose}\n\n" for pose in poses))


def test_binary_text_and_pano360_are_one_scene(root: Path) -> None:
    binary = read_scene(root)
    folder = root / "sparse" / "0"
    shutil.move(folder, root / "binary")
    folder.mkdir()
    pycolmap.Reconstruction(str(root / "binary")).write_text(str(folder))
    assert_same(read_scene(root), binary)
    assert read_scene(root).fingerprint == binary.fingerprint
    as_pano360(root)
    pano360 = read_scene(root)
    assert_same(pano360, binary)
    assert pano360.panoramas[0].image.parent.name == "imgs"
    assert not any(len(p.observed) for p in pano360.panoramas)


def assert_same(a: Scene, b: Scene) -> None:
    assert (a.width, a.height, a.train, a.test) == (b.width, b.height, b.train, b.test)
    np.testing.assert_allclose(a.points, b.points, atol=1e-12)
    np.testing.assert_array_equal(a.colors, b.colors)
    np.testing.assert_allclose(a.centers, b.centers, atol=1e-12)
    assert [p.name for p in a.panoramas] == [p.name for p in b.panoramas]


def test_sub_folders_layers_and_depth_parameters(tmp_path: Path) -> None:
    names = ["a/1.jpg", "b/1.jpg", "b/2.png"]
    root = write_scene(tmp_path / "scene", names=names)
    add(root, "masks", "a/1.jpg.png", GREY)  # as COLMAP names masks
    add(root, "skymasks", "b/1.png", GREY)
    add(root, "depths", "b/2.png", np.ones((8, 16), np.uint16))
    params = {"b/2": {"scale": 2, "offset": -0.5}}
    (root / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))
    first, second, third = read_scene(root).panoramas
    assert (first.stem, first.mask, first.depth) == ("a/1", root / "masks" / "a" / "1.jpg.png", None)
    assert second.sky_mask == root / "skymasks" / "b" / "1.png"
    assert (third.depth, third.depth_affine) == (root / "depths" / "b" / "2.png", (2.0, -0.5))


@pytest.mark.parametrize("extension", ["", ".jpg"])
def test_names_that_differ_in_a_number_after_a_dot(tmp_path: Path, extension: str) -> None:
    root = write_scene(tmp_path / "scene", names=[f"a.{number}{extension}" for number in range(4)])
    for number in range(3):
        add(root, "masks", f"a.{number}.png", GREY)
    (root / "test.txt").write_text(f"a.1\na.3{extension}\n")
    scene = read_scene(root)
    assert [panorama.stem for panorama in scene.panoramas] == ["a.0", "a.1", "a.2", "a.3"]
    assert [panorama.mask for panorama in scene.panoramas] == [
        *(root / "masks" / f"a.{number}.png" for number in range(3)),
        None,
    ]
    assert scene.test == (1, 3)
    assert len({RunFolder(tmp_path).picture(panorama.name) for panorama in scene.panoramas}) == 4
    assert len({file.layer("depths") for file in list_posed_panoramas(root)}) == 4


def test_a_layer_is_found_by_its_older_name(tmp_path: Path) -> None:
    root = write_scene(tmp_path / "scene", names=["a.1", "a.2", "b.1"])
    for name in ("a.png", "b.png", "a.2.png"):
        add(root, "masks", name, GREY)
    assert [panorama.mask and panorama.mask.name for panorama in read_scene(root).panoramas] == [
        None,  # a.png may be of either
        "a.2.png",
        "b.png",
    ]


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_whose_accents_are_spelled_otherwise(form: Literal["NFC", "NFD"], tmp_path: Path) -> None:
    """macOS takes accents apart, other systems and models do not."""
    other: Literal["NFC", "NFD"] = "NFD" if form == "NFC" else "NFC"
    names = [unicodedata.normalize(form, f"Büro/é_{i}.png") for i in range(3)]
    root = write_scene(tmp_path, names=names)
    (root / "masks").mkdir()
    for folder in (root / "images", root / "masks"):
        (folder / unicodedata.normalize(other, "Büro")).mkdir()
    for name in names:
        path = root / "images" / name
        path.rename(root / "images" / unicodedata.normalize(other, name))
        add(root, "masks", unicodedata.normalize(other, name), GREY)
    scene = read_scene(root)
    assert [panorama.name for panorama in scene.panoramas] == names
    assert all(panorama.mask is not None for panorama in scene.panoramas)
    assert [panorama.name for panorama in list_posed_panoramas(root)] == names


def test_an_affine_is_not_that_of_a_map_which_panolog_made_later(root: Path) -> None:
    (root / "depths").mkdir()
    ours = png_with_provenance(np.ones((8, 16), np.uint16), "0" * 64)
    (root / "depths" / "pano_1.png").write_bytes(ours)
    add(root, "depths", "pano_2.png", np.ones((8, 16), np.uint16))
    params = {f"pano_{row}": {"scale": 77, "offset": 0.5} for row in (1, 2)}
    (root / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))
    found = [panorama.depth_affine for panorama in read_scene(root).panoramas[:4]]
    assert found == [None, None, (77.0, 0.5), None]


@pytest.mark.parametrize("mode, bits", [("1", None), ("L", None), ("P", 1), ("P", 2), ("P", 4), ("P", 8)])
def test_masks_of_a_few_bits(root: Path, mode: str, bits: int | None) -> None:
    """PIL writes booleans as one bit."""
    used = np.zeros((32, 64), bool)
    used[:20, 7:] = True
    picture = Image.fromarray(used) if mode == "1" else Image.fromarray(np.where(used, 255, 0).astype("u1"))
    if mode == "P":
        picture = Image.fromarray(used.astype(np.uint8), "P")
        picture.putpalette([0, 0, 0, 255, 255, 255])
    for layer in ("masks", "skymasks"):
        (root / layer).mkdir()
        picture.save(root / layer / "pano_1.png", bits=bits or 8)
    view = load_layers(read_scene(root).panoramas[1], 1, 64)
    assert view.mask is not None and (view.mask.numpy() == used).all()
    assert view.sky is not None and (view.sky.numpy() == ~used).all()


@pytest.mark.parametrize("binary", [True, False])
def test_an_image_name_that_is_not_utf8_is_one_clear_line(root: Path, binary: bool) -> None:
    if not binary:
        as_pano360(root)
    path = root / "sparse" / "0" / f"images.{'bin' if binary else 'txt'}"
    path.write_bytes(path.read_bytes().replace(b"pano_3", b"pan\xf6_3"))
    with pytest.raises(InputError, match=r"images\.(bin|txt): .*is not UTF-8; rename it"):
        read_scene(root)
    with pytest.raises(InputError, match=r"pan\?_3\.jpg is not UTF-8; rename the file"):
        check_names(root, ["a.jpg", os.fsdecode(b"pan\xf6_3.jpg")])


def test_the_fingerprint_knows_what_training_depends_on_and_nothing_else(root: Path) -> None:
    seen = {read_scene(root).fingerprint}
    write_image(root / "images" / "stray.jpg", np.random.default_rng(0), (40, 30))
    assert seen == {read_scene(root).fingerprint}  # the model does not name it
    (root / "test.txt").write_text("pano_1\n")
    seen.add(read_scene(root).fingerprint)
    add(root, "masks", "pano_2.png", GREY)
    seen.add(read_scene(root).fingerprint)
    write_image(root / "images" / "pano_0.jpg", np.random.default_rng(99))
    seen.add(read_scene(root).fingerprint)
    assert len(seen) == 4


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def resized(size: tuple[int, int]) -> Callable[[Path], None]:
    return lambda root: write_image(root / "images" / "pano_3.jpg", np.random.default_rng(0), size)


def as_run(root: Path, without: str) -> None:
    shutil.rmtree(root / without)
    (root / "run.json").touch()


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no scene": (shutil.rmtree, "no such folder"),
    "no model": (lambda r: shutil.rmtree(r / "sparse"), "no COLMAP model"),
    "a run": (lambda r: as_run(r, "sparse"), "is the folder of a run; give the scene"),
    "a run with refined poses": (lambda r: as_run(r, "images"), "is the folder of a run; give the scene"),
    "no image folder": (lambda r: (r / "images").rename(r / "pictures"), "no folder images"),
    "missing image": (lambda r: (r / "images" / "pano_3.jpg").unlink(), r"pano_3\.jpg.*missing"),
    "truncated JPEG": (lambda r: truncate(r / "images" / "pano_3.jpg"), r"pano_3\.jpg.*truncated"),
    "other size": (resized((128, 64)), "pano_3.jpg: 128 x 64 .* one size"),
    "not 2:1": (resized((64, 48)), "pano_3.jpg: 64 x 48 .* not 2:1"),
    "one to train": (lambda r: (r / "train.txt").write_text("pano_3"), "train split has 1 panoramas"),
    "split not UTF-8": (lambda r: (r / "train.txt").write_bytes(b"pano_\xff"), "train.txt: is not UTF-8"),
    "8 bit depth": (lambda r: add(r, "depths", "pano_1.png", GREY), "8 bits .* with 16 bits"),
    "colour depth": (lambda r: add(r, "depths", "pano_1.png", np.zeros((8, 16, 3), np.uint16)), "3 channels"),
    "16 bit mask": (
        lambda r: add(r, "masks", "pano_1.png", GREY.astype(np.uint16)),
        "16 bits .* with 8 bits",
    ),
    "mask not 2:1": (lambda r: add(r, "masks", "pano_1.png", GREY[:, :40]), "40 x 32 .* not 2:1"),
    "masks of nothing": (lambda r: add(r, "skymasks", "other.png", GREY), "no file here belongs"),
    "depth parameters": (
        lambda r: (r / "sparse" / "0" / "depth_params.json").write_text('{"pano_1": 3}'),
        "depth_params.json: not",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_line(root: Path, case: str) -> None:
    change, complaint = BAD[case]
    change(root)
    with pytest.raises(InputError, match=complaint) as error:
        read_scene(root)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["images/pano_3.jpg", "sparse/0/images.bin", "sparse/0/cameras.bin"])
def test_a_file_that_may_not_be_read(root: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def guarded(path: Path, *args: Any, **options: Any) -> Any:  # file modes do not stop root
        if path == root / name:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return path_open(path, *args, **options)

    path_open = Path.open
    monkeypatch.setattr(Path, "open", guarded)
    with pytest.raises(InputError, match=rf"{name}: cannot be read \(Permission denied\)"):
        read_scene(root)


@pytest.mark.parametrize(
    "names, points, complaint",
    [
        (["one.jpg"], 50, "1 posed panoramas"),
        (["a.jpg", "b.jpg"], 50, "2 posed panoramas; at least 3 are needed"),
        (["a.jpg", "b.jpg", "c.jpg"], 0, "0 points"),
        (["a.jpg", "a.png", "b.png"], 50, "2 panoramas are called a"),
        (["a.jpg", "c.jpg", "../b.jpg"], 50, "leaves the image folder"),
    ],
)
def test_scenes_that_cannot_be_trained(tmp_path: Path, names: list[str], points: int, complaint: str) -> None:
    root = write_scene(tmp_path / "scene", names=names, points=points)
    with pytest.raises(InputError, match=complaint):
        read_scene(root)


@pytest.mark.parametrize("elsewhere", [0, 1])  # panoramas held out, which do not help
def test_training_cameras_at_one_place(root: Path, elsewhere: int) -> None:
    as_pano360(root)
    text = "".join(f"{i} 1 0 0 0 {5 if i else 5 + elsewhere} 5 5 1 pano_{i}.jpg\n\n" for i in range(4))
    (root / "sparse" / "0" / "images.txt").write_text(text)
    with pytest.raises(InputError, match="train split have the same position"):
        read_scene(root)


STEMS = [f"walk/{i:02d}" for i in range(17)]


@pytest.mark.parametrize(
    "files, train, test",
    [
        ({"test": "walk/03\nwalk/01.jpg\n\n"}, (0, 2, *range(4, 17)), (1, 3)),
        ({"train": "\ufeffwalk/00\r\nwalk/01\r\n"}, (0, 1), tuple(range(2, 17))),
        ({"train": "walk/05", "test": "walk/04"}, (5,), (4,)),
        ({}, (*range(1, 8), *range(9, 16)), (0, 8, 16)),
    ],
)
def test_files_decide(
    tmp_path: Path, files: dict[str, str], train: tuple[int, ...], test: tuple[int, ...]
) -> None:
    for name, text in files.items():
        (tmp_path / f"{name}.txt").write_text(text, encoding="utf-8")
    assert read_split(tmp_path, STEMS) == (train, test)


@pytest.mark.parametrize(
    "files, complaint",
    [
        ({"test": ""}, "test split is empty"),
        ({"train": "\n"}, "train split is empty"),
        ({"train": "\n".join(STEMS)}, "test split is empty.* to train on all, remove .* --holdout none"),
        ({"test": "walk/99"}, "walk/99 is not a panorama"),
        ({"train": "walk/01", "test": "walk/01"}, "in train.txt and in test.txt"),
    ],
)
def test_a_wrong_split_is_refused(tmp_path: Path, files: dict[str, str], complaint: str) -> None:
    for name, text in files.items():
        (tmp_path / f"{name}.txt").write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_split(tmp_path, STEMS)


def test_panoramas_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    names = [f"walk_{number}.png" for number in range(1, 12)]
    scene = read_scene(write_scene(tmp_path / "scene", names=sorted(names)))
    assert [panorama.name for panorama in scene.panoramas] == names
    assert [scene.panoramas[row].name for row in scene.test] == ["walk_1.png", "walk_9.png"]
