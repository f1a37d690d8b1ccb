"""A walk that falls apart: which parts become scenes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.prepare.sfm.pipeline import SfmSettings, make_scene
from panolog.prepare.sfm.reconstruct import Reconstruction
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.reports import in_a_row

COUNT = 7


def _in_parts(panoramas: Any, layers: Any, *_: object, **__: object) -> list[Reconstruction]:
    """Four panoramas and three, each part in a row."""

    def part(rows: tuple[int, ...], others: list[tuple[int, ...]]) -> Reconstruction:
        missing = {row: (0, 0) for row in range(COUNT) if row not in rows}
        model = in_a_row(rows)
        return Reconstruction(panoramas, layers, (128, 64), model, [], [], missing, others, 100, 9)

    return [part((0, 1, 2, 3), [(4, 5, 6)]), part((4, 5, 6), [(0, 1, 2, 3)])]


@pytest.mark.parametrize("parts", [False, True])
def test_each_part_becomes_a_scene_if_that_is_wanted(
    parts: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.prepare.sfm.pipeline.reconstruct", _in_parts)
    folder = tmp_path / "images"
    folder.mkdir()
    for row in range(COUNT):
        cv2.imwrite(str(folder / f"{row}.png"), np.full((64, 128), 90 + row, np.uint8))
    settings = replace(SfmSettings(parts=parts), distance=("0.png", "2.png", 5.0))
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
