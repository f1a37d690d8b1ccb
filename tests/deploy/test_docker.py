"""The image: hadolint checks its file, and the build context has all sources of the wheel."""

import shutil
import subprocess
from fnmatch import fnmatch

import pytest

from tests.deploy.files import DEPLOY, ROOT
from tests.ray_head import BIN

pytestmark = pytest.mark.system


def test_hadolint_accepts_it() -> None:
    ended = subprocess.run(
        [BIN / "hadolint", DEPLOY / "Dockerfile"], check=False, capture_output=True, text=True
    )
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stdout


def test_the_build_context_has_the_sources_of_the_wheel() -> None:
    lines = (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert all((ROOT / name).exists() for name in kept)
    packages = {link.name for link in (ROOT / "src/panolog").iterdir() if link.is_symlink()}
    assert packages | {"src", "pyproject.toml", "CMakeLists.txt", "README.md", "LICENSE"} <= kept
    copied = [
        word
        for line in (DEPLOY / "Dockerfile").read_text().splitlines()
        if line.startswith("COPY ") and "--from" not in line
        for word in line.split()[1:-1]
        if word != "."
    ]
    assert copied
    for name in copied:
        assert any(fnmatch(name, pattern) or name.startswith(f"{pattern}/") for pattern in kept), name


@pytest.mark.nightly  # most machines have no docker that builds
def test_docker_itself_accepts_it() -> None:
    if shutil.which("docker") is None:
        pytest.skip("there is no docker on this machine")
    if subprocess.run(
        ["docker", "buildx", "inspect"], check=False, capture_output=True, timeout=60
    ).returncode:
        pytest.skip("docker cannot build on this machine: no daemon, or no buildx")
    command = ["docker", "build", "--check", "--file", "deploy/Dockerfile", "."]
    ended = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
