"""Whatever the format, the same scene comes out."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from panolog.prepare.importers.import_scene import import_scene
from panolog.prepare.importers.interface import find_panorama
from panolog.scene.errors import SceneError
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from tests.prepare.importers.files import changed_json, write_ply
from tests.prepare.importers.known import Known
from tests.prepare.importers.writers import WITH_SPLIT, WITH_TRACKS, WRITERS

NOTES = {
    "openmvg, old": "mirror",
    "opensfm": "1 images of 1 smaller reconstructions are left out",
    "metashape": "1 camera (not aligned): left out, as it is not aligned",
}


@pytest.mark.parametrize("case", WRITERS)
def test_same_scene(case: str, tmp_path: Path) -> None:
    kind, writer = WRITERS[case]
    known, source = writer(tmp_path / "source")
    report = import_scene(source, tmp_path / "scene")
    assert report.format == kind  # it was found out
    assert NOTES.get(case, "") in "".join(report.notes[:1])
    scene = read_scene(tmp_path / "scene")
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
    if case in WITH_TRACKS or kind == "panorama_sfm":
        total = same_tracks(known, scene, whole=case in WITH_TRACKS)
        assert report.observations == total > 50


def same_tracks(known: Known, scene: Scene, *, whole: bool) -> int:
    """Checks that panoramas see their points, if not `whole` some, at their pixels; how many there are."""
    model = pycolmap.Reconstruction(str(scene.root / "sparse" / "0"))
    by_name = {image.name: image for image in model.images.values()}
    row_of = {tuple(np.round(point, 6)): row for row, point in enumerate(known.points)}
    total = 0
    for index, panorama in enumerate(scene.panoramas):
        seen = {}
        for observation in by_name[panorama.name].points2D:
            place = model.points3D[observation.point3D_id].xyz
            seen[row_of[tuple(np.round(place, 6))]] = observation.xy
        expected = dict(zip(known.observed[index].tolist(), known.pixels[index], strict=True))
        assert set(seen) == set(expected) if whole else set(seen) <= set(expected)
        for row, pixel in seen.items():
            assert np.abs(pixel - expected[row]).max() < 1e-6
        total += len(seen)
    return total


def test_far_from_the_origin(tmp_path: Path) -> None:
    """UTM coordinates: moved, so that float32 suffices, and the way back is kept."""
    known, source = WRITERS["nerfstudio"][1](tmp_path / "source")
    utm = np.array([512_345.25, 5_403_210.5, 300.0])
    with changed_json(source.path / "transforms.json") as content:
        for frame in content["frames"]:
            for row, shift in zip(frame["transform_matrix"], utm, strict=False):
                row[3] += shift
    write_ply(tmp_path / "source" / "sparse_pc.ply", known.points + utm, known.colors)
    report = import_scene(source, tmp_path / "scene", format="nerfstudio")
    assert "moved to the origin" in report.notes[0]
    scene = read_scene(tmp_path / "scene")
    offset = np.array(json.loads((tmp_path / "scene" / "offset.json").read_text())["offset"])
    assert np.abs(scene.centers).max() < 10
    assert np.abs(scene.centers + offset - known.centers - utm).max() < 1e-6
    assert np.abs(scene.points + offset - known.points - utm).max() < 1e-6


def test_openmvg_in_folders(tmp_path: Path) -> None:
    """Cameras number files alike in each folder, which openMVG writes next to the name."""
    _, source = WRITERS["openmvg"][1](tmp_path / "source")
    with changed_json(source.path / "sfm_data.json") as content:
        for number, view in enumerate(content["views"]):
            data = view["value"]["ptr_wrapper"]["data"]
            path = source.path / f"images/day{number % 2}/{number // 2}.png"
            path.parent.mkdir(exist_ok=True)
            (source.path / "images" / data["filename"]).rename(path)
            data |= {"local_path": f"{path.parent.name}/", "filename": path.name}
    import_scene(source, tmp_path / "scene")
    names = [panorama.name for panorama in read_scene(tmp_path / "scene").panoramas]
    assert names == [f"day{day}/{number}.png" for day in range(2) for number in range(3)]


def test_labels_with_dots_and_without_extension(tmp_path: Path) -> None:
    for name in ("IMG.001.jpg", "a.jpg", "b.png", "c.TIF"):
        (tmp_path / name).touch()
    spelled = {"IMG.001": "IMG.001.jpg", "sub/b.jpeg": "b.png", "C:\\shots\\b": "b.png", "c.tif": "c.TIF"}
    for label, name in spelled.items():
        assert find_panorama("here", [tmp_path], label) == (name, tmp_path / name)
    with pytest.raises(SceneError, match=r"a\.1 is not in"):  # a number after a dot is no extension
        find_panorama("here", [tmp_path], "a.1")
