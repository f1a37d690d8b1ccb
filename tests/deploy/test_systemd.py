"""The systemd unit: systemd itself reads it, and its command runs with a program that records calls."""

import configparser
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.deploy.files import DEPLOY, parsed, programs

UNIT = DEPLOY / "panolog@.service"
QUEUE = DEPLOY / "panolog-queue.service"


def fields(path: Path = UNIT) -> configparser.ConfigParser:
    unit = configparser.ConfigParser(interpolation=None, strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]  # names keep their case
    unit.read_string(path.read_text().replace("\\\n", ""))
    return unit


@pytest.mark.nightly  # many machines have no systemd
@pytest.mark.parametrize(
    ("unit", "name"), [(UNIT, "panolog@street.service"), (QUEUE, "panolog-queue.service")]
)
def test_systemd_accepts_it(tmp_path: Path, unit: Path, name: str) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd on this machine")
    copy = tmp_path / name
    # what this machine has: no user panolog, and no program below /opt
    text = unit.read_text().replace("User=panolog", "User=root")
    copy.write_text(text.replace("/opt/panolog/.venv/bin/panolog", "/bin/true"))
    command = ["systemd-analyze", "verify", "--man=no", str(copy)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True)
    about_it = [line for line in ended.stderr.splitlines() if "panolog" in line]
    assert (ended.returncode, about_it) == (0, []), ended.stderr


@pytest.mark.parametrize("made", [False, True])
def test_its_command_begins_or_resumes_the_run(tmp_path: Path, made: bool) -> None:
    shell = fields()["Service"]["ExecStart"].replace("$$", "$")
    match = re.fullmatch(r"/bin/sh -c '(.*)'", shell)
    assert match is not None
    run, calls = tmp_path / "my run", tmp_path / "calls"
    programs(tmp_path, {"panolog": f'#!/bin/sh\nfor word in "$@"; do echo "$word" >> {calls}; done\n'})
    if made:
        run.mkdir()
        (run / "run.json").touch()
    example = re.search(r"    SCENE=(?s:.*?)\n\n", (DEPLOY / "systemd.md").read_text())
    assert example is not None
    given = dict(line.strip().split("=", 1) for line in example[0].strip().splitlines())
    environment = os.environ | given | {"RUN": str(run), "PATH": f"{tmp_path}:/usr/bin:/bin"}
    subprocess.run(["/bin/sh", "-c", match[1]], check=True, env=environment)
    options = ["--address", "10.0.0.1:6379"]
    settings = ["--blocks", "3x3x1", "--iterations", "30000"]
    begin = ["run", "/data/street", "--output", str(run), "--supervise", *settings, *options]
    resume = ["resume", str(run), "--supervise", *options]
    assert calls.read_text().splitlines() == (resume if made else begin)


def test_the_queue_restarts_after_any_failure_and_stops_as_a_run_does() -> None:
    service, run = fields(QUEUE)["Service"], fields()["Service"]
    assert service["Restart"] == "on-failure"
    assert "RestartPreventExitStatus" not in service  # a failed run does not end a runner that waits
    for name in ("KillMode", "TimeoutStopSec", "OOMPolicy", "SuccessExitStatus", "TasksMax", "LimitNOFILE"):
        assert service[name] == run[name]
    words = service["ExecStart"].replace("${AT_ONCE}", "2").split()
    assert words[0] == "/opt/panolog/.venv/bin/panolog"
    assert parsed(words[1:])["wait"] is True
