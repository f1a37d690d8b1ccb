"""One command for two chapters of a video and photographs, killed in each of its steps, and resumed."""

import hashlib
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.preparation.notes import read_progress
from panolog.scene.read import read_scene
from tests.prepare.sources.street import Street, make_street
from tests.ray_head import environment, wait_until

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(3600)]

# PanoLOG whose supervisor starts drivers that have workers without Ray.
WITHOUT_RAY = """
import sys
from panolog.orchestrator.cli import app
from panolog.orchestrator.cli.session import supervise
from panolog.orchestrator.engine.cluster import connection
from panolog.orchestrator.engine.driver.local_pool import local_pool

connection.connect = lambda *_: local_pool()
supervise._PROGRAM = (sys.executable, __file__)
if __name__ == "__main__":
    app.main()
"""
OPTIONS = ("--width", "128", "--iterations", "20", "--device", "cpu", "--set", "sky.count=50")
MOMENTS = ("frames", "masks", "features", "matches", "poses", "training")
PATIENCE = 1800  # seconds


def command(program: Path, *words: str | Path) -> "subprocess.Popen[bytes]":
    log = program.with_suffix(".log").open("ab")
    with log:
        return subprocess.Popen(
            [sys.executable, str(program), *map(str, words)],
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment(),
        )


def reached(folder: RunFolder, moment: str, process: "subprocess.Popen[bytes]") -> bool:
    """Whether a run is at one of the MOMENTS, or at a later one, or has ended."""
    progress = read_progress(folder)
    what = "training" if folder.preflight.exists() else progress.what if progress else ""
    later = MOMENTS[MOMENTS.index(moment) :]
    return what in later or process.poll() is not None


def content(root: Path) -> dict[str, str]:
    """The digest of each file of a run's scene, and of its model."""
    files = [it for it in (root / "scene").rglob("*") if it.is_file()] + [RunFolder(root).point_cloud]
    return {str(it.relative_to(root)): hashlib.sha256(it.read_bytes()).hexdigest() for it in files}


def test_a_run_of_several_sources_that_is_killed_in_each_step_ends_with_the_same_bytes(
    tmp_path: Path,
) -> None:
    (tmp_path / "in").mkdir()
    street: Street = make_street(tmp_path / "in")
    program = tmp_path / "panolog.py"
    program.write_text(WITHOUT_RAY)
    killed, calm = tmp_path / "killed", tmp_path / "calm"
    process = command(program, "run", *street.all, "-o", killed, *OPTIONS)
    for moment in MOMENTS:
        wait_until(partial(reached, RunFolder(killed), moment, process), moment, PATIENCE)
        assert process.poll() is None, program.with_suffix(".log").read_text()
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process = command(program, "resume", killed)
    assert process.wait(PATIENCE) == 0, program.with_suffix(".log").read_text()
    assert command(program, "run", *street.all, "-o", calm, *OPTIONS).wait(PATIENCE) == 0
    assert content(killed) == content(calm)
    names = [panorama.name for panorama in read_scene(killed / "scene").panoramas]
    assert {name.partition("/")[0] for name in names} == {"GX010001", "GX020001", "stills"}
