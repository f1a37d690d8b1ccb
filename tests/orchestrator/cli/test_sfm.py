"""panolog scene sfm, as a user calls it; tests/prepare/sfm interrupts it."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from panolog.prepare.sfm import pipeline
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.read import read_scene
from tests.orchestrator.cli.program import call, one_line
from tests.prepare.video.videos import render, walk

pytestmark = pytest.mark.system

WIDTH = 640


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five panoramas of a street."""
    folder = tmp_path_factory.mktemp("walk")
    for number, shot in enumerate(walk([0.9] * 5)):
        cv2.imwrite(str(folder / f"{number}.jpg"), render(shot, WIDTH))
    return folder


def test_a_scene_and_its_report(images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output, made, make_scene = tmp_path / "scene", list[SfmReport](), pipeline.make_scene

    def keep(*given: Any) -> SfmReport:
        made.append(make_scene(*given))
        return made[0]

    monkeypatch.setattr(pipeline, "make_scene", keep)
    result = call("scene", "sfm", images, "-o", output, "--json")
    assert result.exit_code == 0, result.output
    shown = json.loads(result.stdout)
    assert (shown["registered"], shown["missing"], shown["contradictions"]) == (5, [], [])
    assert shown["world"]["frame"] == "upright"
    assert shown["error"] < 0.6
    kept = json.loads((output / "sfm.json").read_text())
    assert kept == {key: value for key, value in shown.items() if key != "scene"}
    assert cv2.imread(str(output / "sfm.png")) is not None
    assert len(read_scene(output).panoramas) == 5
    monkeypatch.setattr(pipeline, "make_scene", lambda *_: made[0])
    result = call("scene", "sfm", "images", "-o", tmp_path)
    assert result.exit_code == 0
    assert result.stdout.startswith("5 of 5 panoramas have a pose")
    assert "the world: z up, units of no known scale" in result.stdout


def test_what_cannot_be_done_is_one_line(images: Path, tmp_path: Path) -> None:
    source, output = tmp_path / "images", tmp_path / "scene"
    source.mkdir()
    for name in "ab":
        cv2.imwrite(str(source / f"{name}.jpg"), np.full((WIDTH // 2, WIDTH, 3), 99, np.uint8))
    assert one_line(call("scene", "sfm", source, "-o", output))
    assert call("scene", "sfm", images, "-o", output, "--mapper", "magic").exit_code == 2
    assert not output.exists()
