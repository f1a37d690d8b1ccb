"""The files for `ray up`: Ray's own schema, and what Ray does with them when SSH is a fake."""

import os
import subprocess
from pathlib import Path

import pytest
from ray.autoscaler._private.util import prepare_config, validate_config

from panolog.orchestrator.engine.scheduling.scaling import IDLE_S
from tests.deploy.files import DEPLOY, commands, load, programs
from tests.ray_head import BIN, environment

pytestmark = pytest.mark.system

NAMES = ("on-premises.yaml", "aws.yaml")


@pytest.mark.parametrize("name", NAMES)
def test_ray_accepts_it_and_every_ray_start_uses_the_token_and_notices_lost_machines(name: str) -> None:
    validate_config(prepare_config(load(name)))
    starts = [command for command in commands(load(name)) if "ray start" in command]
    assert len(starts) == 2
    for command in starts:
        assert "RAY_AUTH_MODE=token ray start" in command
        assert "recovery.env; set +a;" in command
    assert load(name)["file_mounts"]["~/.ray/auth_token"] == "~/.ray/auth_token"


def test_workers_of_aws_come_as_requested_and_go_after_an_idle_minute() -> None:
    config = load("aws.yaml")
    worker = config["available_node_types"]["worker"]
    assert (worker["min_workers"], worker["max_workers"]) == (0, config["max_workers"])
    assert 60 * config["idle_timeout_minutes"] == IDLE_S


def test_ray_up_does_what_the_page_says(tmp_path: Path) -> None:
    """The real `ray up`, with an SSH that records its commands."""
    (tmp_path / "dist").mkdir()
    for file in (".ray/auth_token", ".ssh/id_ed25519", "dist/panolog-0.1.0.whl"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("x")
    calls = tmp_path / "calls"
    programs(tmp_path / "bin", {it: f'#!/bin/sh\necho "{it} $*" >> {calls}\n' for it in ("ssh", "rsync")})
    ours = environment() | {"HOME": str(tmp_path), "RAY_TMPDIR": str(tmp_path / "ray")}
    ours["PATH"] = f"{tmp_path / 'bin'}{os.pathsep}{ours['PATH']}"
    command = [f"{BIN}/ray", "up", "--yes", "--no-config-cache", f"{DEPLOY}/on-premises.yaml"]
    ended = subprocess.run(command, check=False, cwd=tmp_path, env=ours, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    log = calls.read_text()
    steps = (
        "-avz dist/ ubuntu@192.0.2.10:~/panolog-dist/",
        "ubuntu@192.0.2.10:~/.ray/auth_token",
        "python3 -m venv ~/panolog",
        'pip install --constraint ~/panolog-dist/constraints.txt "$(ls ~/panolog-dist/panolog-*.whl)[all]"',
        "ray start --head",
    )
    places = [log.index(step) for step in steps]
    assert places == sorted(places)
    assert "192.0.2.11" not in log  # the head starts the workers
