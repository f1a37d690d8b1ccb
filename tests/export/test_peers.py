"""The pinned programs of others are there and run."""

import json

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
