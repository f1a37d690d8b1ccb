"""The image: hadolint checks its file, and the build context has all sources of the wheel."""

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
