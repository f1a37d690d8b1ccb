"""The program, called in this process, for tests."""

import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner, Result

from panolog.orchestrator.cli import app
from panolog.scene.ply import write_ply
from panolog.scene.read import read_scene
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import scene_gaussians
from tests.orchestrator.history import BEGAN, begun
from tests.orchestrator.messages import without_progress

STEPS = (  # of a preflight
    "starting Ray",
    "connecting to the cluster",
    "checking panoramas",
    "measuring exposures",
    "calibrating",
)


@cache
def _program() -> Any:
    """All commands with their options: to make them takes longer than most calls."""
    return get_command(app.app)


def call(*arguments: object) -> Result:
    """What `panolog` with these words prints, and its exit code."""
    runner = CliRunner()
    with runner.isolation() as streams:
        with pytest.raises(SystemExit) as end:
            _program().main([str(argument) for argument in arguments], prog_name="root")
        sys.stdout.flush()
        sys.stderr.flush()
        stdout, stderr, output = (stream.getvalue() for stream in streams)
    return Result(runner, stdout, stderr, output, None, int(end.value.code or 0), None)


def one_line(result: Any) -> str:
    """What is said of wrong input: one line on stderr, nothing on stdout, and exit code 2.

    Args: result, a `Result`, or what has its attributes.
    """
    assert (result.exit_code, result.stdout) == (2, ""), result.output
    (line,) = [line for line in without_progress(result.stderr) if line not in STEPS]
    return line


def shown(*arguments: object) -> Any:
    """The content of what is printed on stdout with --json."""
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def finished(root: Path, scene: Path, fingerprint: str | None = None) -> Path:
    """A run folder with both models. Args: fingerprint, another than that of the scene."""
    read = read_scene(scene)
    folder = begun(root, BEGAN, scene=scene, fingerprint=fingerprint or read.fingerprint)
    folder.of(COARSE).mkdir(parents=True)
    for path in (folder.model(COARSE), folder.point_cloud):
        write_ply(path, scene_gaussians(read))
    return root
