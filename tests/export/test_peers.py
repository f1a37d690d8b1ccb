"""The pinned programs of others are there and run."""

import json
from pathlib import Path

import pytest

from tests.export import peers
from tests.export.peers import LOCK, node, peer


def test_each_peer_has_its_pinned_version() -> None:
    wanted = json.loads(LOCK.with_name("package.json").read_text())["dependencies"]
    found = {name: json.loads((peer(name) / "package.json").read_text())["version"] for name in wanted}
    assert found == wanted


def test_node_runs() -> None:
    done = node("-e", "console.log(process.version)")
    assert done.stdout.startswith("v22."), done.stderr
    assert node("-e", "process.exit(3)").returncode == 3
    version = node(peer("@playcanvas/splat-transform") / "bin/cli.mjs", "--version")
    assert version.returncode == 0 and "3.7.0" in version.stdout + version.stderr


def test_tests_skip_without_npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def which(name: str, path: str) -> str:
        tried.append(name)
        return str(npm)

    npm = tmp_path / "npm"
    npm.write_text("#!/bin/sh\nmkdir node_modules\necho 'npm error network is down' >&2\nexit 1\n")
    npm.chmod(0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("shutil.which", which)
    peers._modules.cache_clear()
    try:
        for _ in range(2):
            with pytest.raises(pytest.skip.Exception, match="npm error network is down"):
                peer("three")
        assert tried == ["npm"]
        assert not any(path.is_dir() for path in (tmp_path / "panolog").iterdir() if path.suffix != ".part")
    finally:
        peers._modules.cache_clear()
