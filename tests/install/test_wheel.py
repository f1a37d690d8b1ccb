"""The wheel in an empty environment: what `pip install panolog` brings, and that it is enough to train."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from panolog.scene.errors import PACKAGES
from tests.scenes import write_scene

ROOT = Path(__file__).parents[2]
MOST = 5_000_000  # bytes of the wheel
LOOK = f"""
import sys, panolog
from importlib.util import find_spec
assert "torch" not in sys.modules
for name in panolog.__all__:
    try:
        getattr(panolog, name)
    except panolog.MissingPackageError:
        assert "import" in name.lower() or "register" in name or "find" in name, name
packages = {set(PACKAGES)!r}
assert not packages & set(sys.modules), packages & set(sys.modules)
print([name for name in packages if find_spec(name)])
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That of an environment with the core alone."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = ["--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run([*pip, "wheel", *build], check=True)
    (wheel,) = folder.glob("panolog-*.whl")
    assert wheel.stat().st_size < MOST
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    own = folder / "venv" / "bin" / "python"
    constraint = ["--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, "--python", own, "install", *constraint, wheel], check=True)
    return own


def call(*command: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [*map(str, command)], check=False, cwd=cwd, env=environment, capture_output=True, text=True
    )


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_the_core_trains_and_says_what_it_lacks(python: Path, tmp_path: Path) -> None:
    looked = call(python, "-c", LOOK, cwd=tmp_path)
    assert (looked.returncode, looked.stdout, looked.stderr) == (0, "[]\n", "")
    write_scene(tmp_path / "scene")
    script = ROOT / "examples" / "custom_training.py"
    options = ["--iterations", 50, "--width", 32]
    trained = call(python, script, "scene", "model.ply", *options, cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    assert "iteration 50: loss 0." in trained.stdout
    assert (tmp_path / "model.ply").is_file()
    program = python.with_name("panolog")
    for command, said in (
        (["scene", "sfm", "scene/images", "-o", "made"], "pycolmap: pip install 'panolog[prepare]'"),
        (["dashboard"], "Starlette: pip install 'panolog[dashboard]'"),
    ):
        ended = call(program, *command, cwd=tmp_path)
        assert (ended.returncode, ended.stderr.splitlines()[-1]) == (2, f"panolog: this needs {said}")
