"""The core, without the packages of the extras: it imports, and commands say in one line what they need."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from panolog.scene.errors import PACKAGES
from panolog.scene.ply import write_ply
from panolog.scene.read import read_scene
from panolog.workers.training.initialise import scene_gaussians
from tests.scenes import write_scene

WITHOUT_EXTRAS = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {set(PACKAGES)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in {set(PACKAGES)!r} else found(name)
"""


def core(script: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Runs a script where nothing but the core is installed."""
    command = [sys.executable, "-c", WITHOUT_EXTRAS + script]
    return subprocess.run(command, check=False, capture_output=True, text=True, cwd=cwd)


COMMANDS = {
    "scene sfm raw -o scene": "this needs pycolmap: pip install 'panolog[prepare]'",
    "scene stitch raw -o scene": "this needs PyAV: pip install 'panolog[prepare]'",
    "run raw -o run": "this needs PyAV: pip install 'panolog[prepare]'",
    "dashboard .": "this needs Starlette: pip install 'panolog[dashboard]'",
    "run scene -o run --address auto": "this needs Ray: pip install 'panolog[cluster]'",
    "export model.ply -o out --3dtiles --epsg 25832": "this needs pyproj: pip install 'panolog[export]'",
}
EACH = f"""
import json
from typer.testing import CliRunner
from panolog.orchestrator.cli.app import app
for command in {list(COMMANDS)!r}:
    ended = CliRunner().invoke(app, command.split())
    print(json.dumps([ended.exit_code, ended.stdout, ended.stderr]))
"""


def test_a_command_says_which_extra_it_needs(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    shutil.copytree(scene / "images", tmp_path / "raw")
    write_ply(tmp_path / "model.ply", scene_gaussians(read_scene(scene)))
    ended = core(EACH, tmp_path)
    assert ended.returncode == 0, ended.stderr
    for said, line in zip(COMMANDS.values(), ended.stdout.splitlines(), strict=True):
        code, stdout, stderr = json.loads(line)
        assert (code, stdout, stderr.splitlines()[-1]) == (2, "", f"panolog: {said}")
    assert not (tmp_path / "run").exists()


@pytest.mark.system
def test_a_run_goes_without_ray_and_leaves_nothing_out(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene")
    command = ["run", "scene", "-o", "run", "--iterations", 10, "--set", "sky.count=20", "--device", "cpu"]
    program = f"from panolog.orchestrator.cli.app import app; app({[*map(str, command)]!r})"
    ended = core(program, tmp_path)
    assert ended.returncode == 0, ended.stderr
    run = tmp_path / "run"
    assert (run / "point_cloud.ply").is_file()
    assert list(run.rglob("plan.png"))
    assert (run / "report.html").is_file()
