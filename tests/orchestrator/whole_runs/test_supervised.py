"""Whole runs under a supervisor, whose drivers are killed, lose Ray itself, or are stopped."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.driver.local_pool import local_pool
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.control import state_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Noticed, Outcome, RunBegan, RunEnded, TaskYielded
from panolog.orchestrator.runs.state import RunState, ignore
from panolog.orchestrator.runs.store import read_records
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.orchestrator.whole_runs.test_whole_runs import SETS
from tests.ray_head import environment, wait_until

pytestmark = pytest.mark.system

SETTINGS = (*SETS, "iterations=120", "blocks=1x1x1", "width=64")
OPTIONS = [word for setting in SETTINGS for word in ("--set", setting)]
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


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("supervised") / "town", panoramas=9, width=64, points=300)


def supervise(program: list[str], scene: Path, root: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, *program, "run", str(scene), "-o", str(root), *OPTIONS]
    # A shell's background jobs ignore Ctrl-C; Ray gives a lost head a minute to come back.
    return subprocess.Popen(
        [*command, *more, "--supervise"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=environment() | {"RAY_gcs_rpc_server_reconnect_timeout_s": "2"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )


def driver_with(root: Path, holds: Callable[[RunState], object], but: list[int]) -> psutil.Process:
    """The run's driver, when it is none of those and the state is as wanted."""

    def found() -> bool:
        state = state_of(root)
        return state.driver is not None and state.driver.pid not in but and bool(holds(state))

    wait_until(found, "the driver to kill")
    driver = state_of(root).driver
    assert driver is not None
    but.append(driver.pid)
    return psutil.Process(driver.pid)


def test_a_run_whose_driver_is_killed_and_loses_ray_ends_with_the_same_bytes(
    scene: Path, tmp_path: Path
) -> None:
    root, seen = tmp_path / "run", list[int]()
    process = supervise(["-m", "panolog.orchestrator.cli"], scene, root)
    driver_with(root, lambda state: state.task(COARSE).checkpoint, seen).kill()
    driver = driver_with(root, lambda state: "running" in {it.status for it in state.tasks.values()}, seen)
    (head,) = (child for child in driver.children(recursive=True) if child.name() == "gcs_server")
    head.kill()
    _, stderr = process.communicate(timeout=480)
    assert process.returncode == 0, stderr
    assert "Traceback" not in stderr
    records = [item.record for item in read_records(RunFolder(root).database, limit=10**6)]
    assert [record.pid for record in records if isinstance(record, RunBegan)][:2] == seen
    notices = [record.message for record in records if isinstance(record, Noticed)]
    resumed = [
        it.split("after: ")[1][:25] for it in notices if it.startswith("resumed by the supervisor after: ")
    ]
    assert resumed == ["killed by signal 9 (SIGKI", "exit code 1 without a rec"]
    assert [record.outcome for record in records if isinstance(record, RunEnded)] == ["done"]
    calm = tmp_path / "calm"
    with local_pool() as pool:
        session.start(scene, calm, load_config(sets=SETTINGS), None, ignore, pool)
    assert (root / "point_cloud.ply").read_bytes() == (calm / "point_cloud.ply").read_bytes()


def test_ctrl_c_of_a_terminal_stops_supervisor_and_driver_after_a_fresh_checkpoint(
    scene: Path, tmp_path: Path
) -> None:
    root, program = tmp_path / "run", tmp_path / "program.py"
    program.write_text(WITHOUT_RAY)
    process = supervise([str(program)], scene, root, "--iterations", "100000")
    driver_with(root, lambda state: state.task(COARSE).checkpoint, [])
    os.killpg(process.pid, signal.SIGINT)  # the driver gets it twice
    _, stderr = process.communicate(timeout=480)
    assert process.returncode == 130, stderr
    assert "Traceback" not in stderr
    records = [item.record for item in read_records(RunFolder(root).database)]
    assert TaskYielded(COARSE) in records
    assert records[-1] == RunEnded(Outcome.INTERRUPTED)
    assert f"panolog: stopped; `panolog resume {root}` resumes the run" in stderr.splitlines()
