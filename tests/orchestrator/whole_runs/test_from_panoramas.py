"""From panoramas or a video to a PLY with one command, killed on the way: the same bytes."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from panolog.orchestrator.preparation.settings import Step, read_settings
from panolog.orchestrator.run.folder import RunFolder
from panolog.scene.read import read_scene
from tests.orchestrator.whole_runs.test_whole_runs import (
    IN_STAGE_ONE,
    SETTINGS,
    end_of,
    launch,
    wait_for_workers,
)
from tests.prepare.video.videos import render, walk, write_video

# tests/orchestrator/preparation kills each step with a fake of SfM, tests/prepare/sfm the real one.
pytestmark = [pytest.mark.system, pytest.mark.nightly]

WIDTH = 512
OPTIONS = ("--width", "128", *SETTINGS)
# A driver that kills itself when the preparation is at a part of a step.
KILLED = """
import os, signal, sys
from panolog.orchestrator.cli import app
from panolog.orchestrator.preparation import notes

what, done, write = sys.argv.pop(1), int(sys.argv.pop(1)), notes.write_note

def written(path, note):
    write(path, note)
    if getattr(note, "what", "") == what and note.done >= done:
        os.kill(os.getpid(), signal.SIGKILL)

notes.write_note = written
app.main()
"""


def killed_at(what: str, done: int, *arguments: object) -> None:
    command = [sys.executable, "-c", KILLED, what, str(done), *map(str, arguments)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert ended.returncode == -9, ended.stderr


def source(folder: Path, kind: str) -> Path:
    """Six panoramas of a street, or a video of the way along them."""
    if kind == "video":
        return write_video(folder / "walk.avi", [render(shot, WIDTH) for shot in walk([0.2] * 26)])
    (folder / "walk").mkdir()
    for number, shot in enumerate(walk([0.9] * 6)):
        cv2.imwrite(str(folder / "walk" / f"pano {number}.png"), render(shot, WIDTH))
    return folder / "walk"


@pytest.mark.parametrize(("kind", "what", "done"), [("folder", "features", 2), ("video", "poses", 0)])
def test_a_run_of_panoramas_killed_twice_ends_with_the_same_bytes(
    kind: str, what: str, done: int, tmp_path: Path
) -> None:
    given = source(tmp_path, kind)
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    undisturbed = launch("run", given, "-o", calm, *OPTIONS)
    killed_at(what, done, "run", given, "-o", killed, *OPTIONS)
    assert not RunFolder(killed).scene.exists()
    end = end_of(launch("resume", killed, accidents=IN_STAGE_ONE))
    assert end.code == -9, end.stderr
    wait_for_workers(killed)
    end = end_of(launch("resume", killed))
    assert end.code == 0, end.stderr
    calm_end = end_of(undisturbed)
    assert (calm_end.code, calm_end.stdout) == (0, ""), calm_end.stderr
    assert "Traceback" not in calm_end.stderr + end.stderr
    names = [
        "point_cloud.ply",
        "coarse/model.ply",
        "scene/sparse/0/points3D.bin",
        "scene/sparse/0/images.bin",
    ]
    names += [path.relative_to(calm).as_posix() for path in (calm / "scene" / "masks").iterdir()]
    for name in names:
        assert (killed / name).read_bytes() == (calm / name).read_bytes(), name
    settings = read_settings(RunFolder(killed))
    assert settings is not None
    assert (settings.video, settings.steps()) == (kind == "video", (Step.MASKS, Step.SFM, Step.CHECK))
    assert len(read_scene(killed / "scene").panoramas) >= 4
    assert not list(killed.rglob("*.part"))
    assert not (killed / "scene.sfm").exists()
