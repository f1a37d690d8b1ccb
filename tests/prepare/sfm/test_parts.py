"""A walk that falls apart: which parts become scenes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.scene.errors import InputError, SceneError
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.reports import in_a_row

COUNT = 7


def _in_parts(panoramas: Any, folder: Path, **_: object) -> list[Reconstruction]:
    """Four panoramas and three, each part in a row."""
    folder.mkdir(exist_ok=True)

    def part(rows: tuple[int, ...], others: list[tuple[int, ...]]) -> Reconstruction:
        missing = {row: (0, 0) for row in range(COUNT) if row not in rows}
        model = in_a_row(rows)
        return Reconstruction(panoramas, (128, 64), model, [], [], missing, frozenset(), others, 100, 9)

    return [part((0, 1, 2, 3), [(4, 5, 6)]), part((4, 5, 6), [(0, 1, 2, 3)])]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Panoramas that fall apart into two parts."""
    monkeypatch.setattr("panolog.prepare.sfm.pipeline.reconstruct", _in_parts)
    folder = tmp_path / "images"
    folder.mkdir()
    for row in range(COUNT):
        cv2.imwrite(str(folder / f"{row}.png"), np.full((64, 128), 90 + row, np.uint8))
    return folder


@pytest.mark.parametrize("parts", [False, True])
def test_each_part_becomes_a_scene_if_that_is_wanted(parts: bool, folder: Path, tmp_path: Path) -> None:
    settings = replace(SfmSettings(parts=parts), distance=("0.tif", "2", 5.0))  # its names before
    report = make_scene(folder, tmp_path / "scene", settings, no_progress)
    assert report.as_json()["registered"] == 4
    assert report.as_json()["parts"] == [["4.png", "5.png", "6.png"]]
    first = read_scene(tmp_path / "scene")
    assert [panorama.name for panorama in first.panoramas] == ["0.png", "1.png", "2.png", "3.png"]
    assert np.linalg.norm(first.centers[2] - first.centers[0]) == pytest.approx(5.0)
    assert (tmp_path / "scene-2").exists() == parts
    if parts:
        names = [panorama.name for panorama in read_scene(tmp_path / "scene-2").panoramas]
        assert names == ["4.png", "5.png", "6.png"]
        assert (tmp_path / "scene-2" / "sfm.json").is_file()


@pytest.mark.parametrize(
    ("distance", "problem"),
    [
        (("0.png", "11.png", 5.0), "11.png is not there; name two of the 7 panoramas"),
        (("0.png", "0.png", 5.0), "give two panoramas"),
        (("0.png", "2.png", -5.0), "-5 m is not a distance; give metres above 0"),
    ],
)
def test_a_distance_of_nothing_is_refused_before_there_are_poses(
    distance: tuple[str, str, float],
    problem: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr("panolog.prepare.sfm.pipeline.reconstruct")
    with pytest.raises(InputError, match=problem):
        make_scene(folder, tmp_path / "scene", SfmSettings(distance=distance), no_progress)
    both = SfmSettings(distance=("0.png", "2.png", 5.0), trajectory=tmp_path / "walk.txt")
    with pytest.raises(InputError, match="--distance and --trajectory both"):
        make_scene(folder, tmp_path / "scene", both, no_progress)


def test_an_interrupted_call_is_resumed_where_some_parts_are_scenes(folder: Path, tmp_path: Path) -> None:
    scenes = tmp_path / "scene", tmp_path / "scene-2"

    def interrupted(stage: str, *_: int) -> None:
        if stage == "scene" and scenes[1].exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_scene(folder, scenes[0], SfmSettings(parts=True), interrupted)
    assert [scene.exists() for scene in scenes] == [False, True]
    make_scene(folder, scenes[0], SfmSettings(parts=True), no_progress)
    assert [len(read_scene(scene).panoramas) for scene in scenes] == [4, 3]
    assert not scenes[0].with_name("scene.sfm").exists()


def test_a_scene_of_the_user_is_not_taken_for_a_part(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "scene-2").mkdir()
    (tmp_path / "scene-2" / "mine.txt").touch()
    with pytest.raises(SceneError, match="scene-2: already exists"):
        make_scene(folder, tmp_path / "scene", SfmSettings(parts=True), no_progress)
    assert [file.name for file in (tmp_path / "scene-2").iterdir()] == ["mine.txt"]
