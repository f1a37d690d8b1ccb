"""Two chapters of a video and photographs, of other sizes, of one street: they become one scene."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.pipeline import SfmSettings, make_scene, workspace_folder
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.prepare.sources.find import find_sources
from panolog.prepare.sources.gather import Gathered, gather
from panolog.scene.errors import InputError
from panolog.scene.image_files import read_info
from panolog.scene.read import read_scene
from panolog.scene.write import StageProgress, no_progress
from tests.prepare.sfm.accuracy import drift
from tests.prepare.sfm.reports import in_a_row
from tests.prepare.sources.street import PHOTOGRAPH, STEP, Street, make_street
from tests.prepare.world.stills import crop, write_still


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    return make_street(tmp_path_factory.mktemp("street"))


def gathered(street: Street, work: Path, progress: StageProgress = no_progress) -> Gathered:
    return gather(find_sources(street.all), work, SfmSettings(), progress)


def test_each_source_is_chosen_by_itself_and_follows_in_time(street: Street, tmp_path: Path) -> None:
    steps = list[tuple[str, float]]()
    found = gathered(street, tmp_path, lambda what, done, total: steps.append((what, done / total)))
    names = [panorama.name for panorama in found.panoramas]
    assert names[:4] == ["stills/9.jpg", "stills/8.jpg", "stills/7.jpg", "stills/6.jpg"]  # by EXIF
    labels = [panorama.source for panorama in found.panoramas]
    assert labels == sorted(labels, key=["stills", "GX010001", "GX020001"].index)
    assert all(name.startswith(f"{label}/") for name, label in zip(names, labels, strict=True))
    for label in ("GX010001", "GX020001"):
        along = [street.along(name) for name in names if name.startswith(label)]
        assert along == sorted(along) and len(along) >= 4
        assert along[-1] - along[0] == pytest.approx(11 * STEP)  # both ends
    assert {(info.width, info.height) for info in (read_info(it.path) for it in found.panoramas)} == {
        (PHOTOGRAPH, PHOTOGRAPH // 2)
    }
    assert [it.name for it in found.panoramas if "masks" in it.layers] == ["stills/8.jpg"]
    assert [line for line in found.left_out if "copy" in line] == list(found.left_out)
    assert any(" of another size than 640 x 320: scaled to it" in note for note in found.notes)
    order = list(dict.fromkeys(what for what, _ in steps))
    assert order == ["frames", "metadata", "sizes"]
    for what in order:
        shares = [share for name, share in steps if name == what]
        assert shares == sorted(shares) and shares[-1] == 1


def content(found: Gathered) -> dict[str, str]:
    return {it.name: hashlib.sha256(it.path.read_bytes()).hexdigest() for it in found.panoramas}


def test_what_was_stopped_ends_the_same(street: Street, tmp_path: Path) -> None:
    # Stages, and shares of them.
    stops = [("frames", 0.3), ("frames", 0.8), ("metadata", 0.4), ("sizes", 0.2)]
    left = stops.copy()

    def stop(what: str, done: int, total: int) -> None:
        if left and what == left[0][0] and done > left[0][1] * total:
            del left[0]
            raise KeyboardInterrupt

    calm = gathered(street, tmp_path / "calm")
    for _ in stops:
        with pytest.raises(KeyboardInterrupt):
            gathered(street, tmp_path / "stopped", stop)
    found = gathered(street, tmp_path / "stopped", stop)
    assert not left
    assert content(found) == content(calm) and list(content(found)) == list(content(calm))
    before = {it: it.stat().st_mtime_ns for it in (tmp_path / "stopped").rglob("*") if it.is_file()}
    gathered(street, tmp_path / "stopped")
    assert {it: it.stat().st_mtime_ns for it in before} == before  # nothing is made again


def _in_a_row(panoramas: tuple[PanoramaFile, ...], *_: Any, **__: Any) -> Any:
    """A reconstruction of all panoramas, a metre from one to the next, in place of a search for poses."""
    model = in_a_row(tuple(range(len(panoramas))))
    size = (PHOTOGRAPH, PHOTOGRAPH // 2)
    return [Reconstruction(panoramas, size, model, [], [], {}, frozenset(), [], 100, 9)]


@pytest.mark.parametrize(
    "posed", [False, pytest.param(True, marks=[pytest.mark.system, pytest.mark.nightly])]
)
def test_they_become_one_scene(
    posed: bool, street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Args: posed, whether poses are found, as sfm/test_street.py finds them for other sources."""
    if not posed:
        monkeypatch.setattr("panolog.prepare.sfm.pipeline.reconstruct", _in_a_row)
    report = make_scene(street.all, tmp_path / "scene", SfmSettings(), no_progress)
    scene = read_scene(tmp_path / "scene")
    names = [panorama.name for panorama in scene.panoramas]
    assert scene.width == PHOTOGRAPH and len(names) == len(report.found.panoramas) >= 12
    if posed:
        truth = np.array([[0.0, 0.0, street.along(name)] for name in names])
        assert drift(scene.centers, truth) < 0.02 * np.ptp(truth)
    assert (scene.panoramas[names.index("stills/8.jpg")].mask is None) is False
    said = json.loads((tmp_path / "scene" / "sfm.json").read_text())["sources"]
    assert [(it["name"], it["path"]) for it in said] == [
        ("stills", str(street.photographs)),
        ("GX010001", str(street.first)),
        ("GX020001", str(street.second)),
    ]
    assert all(it["registered"] == it["panoramas"] for it in said)
    assert sum(it["panoramas"] for it in said) == len(names)
    assert f"GX020001, of {street.second}: " in "\n".join(report.lines())
    assert not workspace_folder(tmp_path / "scene").exists()


def test_cropped_photographs_of_several_folders_stay_with_their_folder(tmp_path: Path) -> None:
    for number, folder in enumerate(("north", "south", "west")):
        (tmp_path / folder).mkdir()
        pixels = np.full((40, 128, 3), 50 + 100 * number, np.uint8)
        panorama = crop((128, 64), 0, 12, (128, 40))
        write_still(tmp_path / folder / "a.jpg", pixels, panorama=panorama)
    folders = [tmp_path / it for it in ("north", "south", "west")]
    found = gather(find_sources(folders), tmp_path / "work", SfmSettings(), no_progress)
    assert [(it.name, it.source) for it in found.panoramas] == [
        ("north/a.png", "north"),
        ("south/a.png", "south"),
        ("west/a.png", "west"),
    ]


def test_a_trajectory_of_times_is_refused_before_anything_is_done(street: Street, tmp_path: Path) -> None:
    walk_file = tmp_path / "walk.tum"
    walk_file.write_text("".join(f"{time} {time} 0 0 0 0 0 1\n" for time in range(4)))
    with pytest.raises(InputError, match=r"walk\.tum: has times and no names"):
        make_scene(street.all, tmp_path / "scene", SfmSettings(trajectory=walk_file), no_progress)
    assert not workspace_folder(tmp_path / "scene").exists()
