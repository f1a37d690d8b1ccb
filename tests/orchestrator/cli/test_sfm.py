"""panolog scene sfm, as a user calls it."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import pytest
from typer.testing import Result

from panolog.prepare.sfm import pipeline
from panolog.prepare.sfm.report import SfmReport
from panolog.scene.read import read_scene
from tests.data import reduced
from tests.orchestrator.cli.program import call
from tests.prepare.video.videos import render, walk

pytestmark = pytest.mark.system

WIDTH = 640
_INTERRUPTED = """import os, signal
from panolog.orchestrator.cli.app import main
from panolog.prepare.sfm import reconstruct
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background are born without it
choose_pairs = reconstruct.choose_pairs
def interrupted(*arguments):
    os.killpg(0, signal.SIGINT)  # the whole group of processes, as a terminal does it
    return choose_pairs(*arguments)
reconstruct.choose_pairs = interrupted
main()
"""


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five panoramas of a street."""
    folder = tmp_path_factory.mktemp("walk")
    for number, shot in enumerate(walk([0.9] * 5)):
        cv2.imwrite(str(folder / f"{number}.jpg"), render(shot, WIDTH))
    return folder


class Resumed(NamedTuple):
    """A job that Ctrl-C stopped and the same command finished."""

    stopped: int  # exit code
    before: str  # what the first printed on stderr
    left: bool  # whether the first left a scene
    output: Path
    result: Result  # of the second, with --json
    made: SfmReport  # what the second printed


@pytest.fixture(scope="module")
def resumed(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Resumed:
    """Ctrl-C once all features are found."""
    output, made = tmp_path_factory.mktemp("made") / "scene", list[SfmReport]()
    process = subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTED, "scene", "sfm", str(images), "-o", str(output)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    seen = process.communicate()[1]
    left, make_scene = output.exists(), pipeline.make_scene

    def keep(*arguments: Any) -> SfmReport:
        made.append(make_scene(*arguments))
        return made[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "make_scene", keep)
        result = call("scene", "sfm", images, "-o", output, "--json")
    assert result.exit_code == 0, result.output
    return Resumed(process.returncode, seen, left, output, result, made[0])


def test_a_scene_and_its_report(resumed: Resumed) -> None:
    output, shown = resumed.output, json.loads(resumed.result.stdout)
    assert (shown["registered"], shown["missing"], shown["contradictions"]) == (5, [], [])
    assert shown["world"]["frame"] == "upright"
    assert shown["error"] < 0.6
    kept = json.loads((output / "sfm.json").read_text())
    assert kept == {key: value for key, value in shown.items() if key != "scene"}
    assert cv2.imread(str(output / "sfm.png")) is not None
    assert len(read_scene(output).panoramas) == 5


def test_lines_for_people(resumed: Resumed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "make_scene", lambda *_: resumed.made)
    result = call("scene", "sfm", "images", "-o", tmp_path)
    assert result.exit_code == 0
    assert result.stdout.startswith("5 of 5 panoramas have a pose")
    assert "the world: z up, units of no known scale" in result.stdout


def test_four_places_end_with_one_line(tmp_path: Path) -> None:
    source = reduced("unconnected", 640, tmp_path / "images")
    result = call("scene", "sfm", source, "-o", tmp_path / "scene")
    assert result.exit_code == 2
    assert not (tmp_path / "scene").exists()
    last = result.stderr.strip().splitlines()[-1]
    assert "the 4 panoramas could not be connected" in last
    assert "take them closer" in last


def test_an_option_that_is_none(images: Path, tmp_path: Path) -> None:
    assert call("scene", "sfm", images, "-o", tmp_path / "scene", "--mapper", "magic").exit_code == 2
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_loses_nothing(resumed: Resumed) -> None:
    assert resumed.stopped == 130, resumed.before
    assert not resumed.left
    assert "Traceback" not in resumed.before
    again = [line for line in resumed.result.stderr.splitlines() if line.startswith("features: ")]
    assert again in ([], ["features: 5 of 5"])  # at once: they were kept
