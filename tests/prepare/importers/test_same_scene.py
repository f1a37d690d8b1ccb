"""Whatever the format, the same scene comes out."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from panolog.prepare.importers.import_scene import ImportReport, import_scene
from panolog.prepare.importers.interface import find_panorama
from panolog.scene.errors import SceneError
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from tests.prepare.importers.files import write_ply
from tests.prepare.importers.known import Known
from tests.prepare.importers.writers import WITH_SPLIT, WITH_TRACKS, WRITERS


def imported(case: str, folder: Path, *, link: bool = False) -> tuple[Known, Scene, ImportReport]:
    kind, writer = WRITERS[case]
    known, source = writer(folder / "source")
    report = import_scene(source, folder / "scene", link=link)
    assert report.format == kind  # it was found out
    return known, read_scene(folder / "scene"), report


@pytest.mark.parametrize("case", WRITERS)
def test_same_scene(case: str, tmp_path: Path) -> None:
    known, scene, _ = imported(case, tmp_path)
    assert [panorama.name for panorama in scene.panoramas] == list(known.names)
    rotations = np.stack([panorama.rotation for panorama in scene.panoramas])
    assert np.abs(rotations - known.rotations).max() < 1e-6
    assert np.abs(scene.centers - known.centers).max() < 1e-6
    order, expected = (np.lexsort(points.T) for points in (scene.points, known.points))
    assert np.abs(scene.points[order] - known.points[expected]).max() < 1e-6
    assert (scene.colors[order] == known.colors[expected]).all()
    for panorama in scene.panoramas:
        (original,) = (tmp_path / "source").rglob(panorama.name)
        assert panorama.image.read_bytes() == original.read_bytes()
    if case in WITH_SPLIT:
        assert scene.test == (2, 3)
        assert scene.train == (0, 1, 4, 5)


@pytest.mark.parametrize("case", [*sorted(WITH_TRACKS), "panorama_sfm", "panorama_sfm, one ring"])
def test_tracks(case: str, tmp_path: Path) -> None:
    """Where the format has tracks, each panorama sees the same points at the same pixels."""
    known, scene, report = imported(case, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    by_name = {image.name: image for image in model.images.values()}
    row_of = {tuple(np.round(point, 6)): row for row, point in enumerate(known.points)}
    total = 0
    for index, panorama in enumerate(scene.panoramas):
        seen = {}
        for observation in by_name[panorama.name].points2D:
            place = model.points3D[observation.point3D_id].xyz
            seen[row_of[tuple(np.round(place, 6))]] = observation.xy
        expected = dict(zip(known.observed[index].tolist(), known.pixels[index], strict=True))
        assert set(seen) <= set(expected) if case not in WITH_TRACKS else set(seen) == set(expected)
        for row, pixel in seen.items():
            assert np.abs(pixel - expected[row]).max() < 1e-6
        total += len(seen)
    assert report.observations == total > 50


def test_notes(tmp_path: Path) -> None:
    """What was left out or changed is reported."""
    assert "mirror" in imported("openmvg, old", tmp_path / "a")[2].notes[0]
    assert imported("opensfm", tmp_path / "b")[2].notes == (
        "1 images of 1 smaller reconstructions are left out",
    )
    assert imported("metashape", tmp_path / "c")[2].notes == ("not aligned is not aligned and is left out",)


def test_far_from_the_origin(tmp_path: Path) -> None:
    """UTM coordinates: moved, so that float32 suffices, and the way back is kept."""
    known, source = WRITERS["nerfstudio"][1](tmp_path / "source")
    utm = np.array([512_345.25, 5_403_210.5, 300.0])
    path = tmp_path / "source" / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        for row, shift in zip(frame["transform_matrix"], utm, strict=False):
            row[3] += shift
    path.write_text(json.dumps(content))
    write_ply(tmp_path / "source" / "sparse_pc.ply", known.points + utm, known.colors)
    report = import_scene(source, tmp_path / "scene")
    assert "moved to the origin" in report.notes[0]
    scene = read_scene(tmp_path / "scene")
    offset = np.array(json.loads((tmp_path / "scene" / "offset.json").read_text())["offset"])
    assert np.abs(scene.centers).max() < 10
    assert np.abs(scene.centers + offset - known.centers - utm).max() < 1e-6
    assert np.abs(scene.points + offset - known.points - utm).max() < 1e-6


def test_labels_with_dots_and_without_extension(tmp_path: Path) -> None:
    for name in ("IMG.001.jpg", "b.png"):
        (tmp_path / name).touch()
    for label, name in (("IMG.001", "IMG.001.jpg"), ("sub/b.jpeg", "b.png"), ("C:\\shots\\b", "b.png")):
        assert find_panorama("here", [tmp_path], label) == (name, tmp_path / name)


def test_a_number_after_a_dot_is_no_extension(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    with pytest.raises(SceneError, match=r"a\.1 is not in"):
        find_panorama("here", [tmp_path], "a.1")


def test_links(tmp_path: Path) -> None:
    _, scene, _ = imported("nerfstudio", tmp_path, link=True)
    for panorama in scene.panoramas:
        assert panorama.image.is_symlink()
        assert panorama.image.resolve() == (tmp_path / "source" / "images" / panorama.name).resolve()
