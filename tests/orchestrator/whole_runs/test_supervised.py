"""A whole run under a supervisor, whose drivers are killed or lose Ray itself."""

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
from panolog.orchestrator.runs.database import read_records
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Noticed, RunBegan, RunEnded
from panolog.orchestrator.runs.state import RunState, ignore
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.orchestrator.whole_runs.test_whole_runs import SETS
from tests.ray_head import environment, wait_until

pytestmark = pytest.mark.system

SETTINGS = (*SETS, "iterations=120", "blocks=1x1x1", "width=64")
OPTIONS = [word for setting in SETTINGS for word in ("--set", setting)]


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


def test_a_run_whose_driver_is_killed_and_loses_ray_ends_with_the_same_bytes(tmp_path: Path) -> None:
    root, seen = tmp_path / "run", list[int]()
    scene = make_town(tmp_path / "town", panoramas=9, width=64, points=300)
    words = ["run", str(scene), "-o", str(root), *OPTIONS, "--supervise"]
    # Ray gives a lost head a minute to come back.
    ours = environment() | {"RAY_gcs_rpc_server_reconnect_timeout_s": "2"}
    process = subprocess.Popen(
        [sys.executable, "-m", "panolog.orchestrator.cli", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=ours,
    )
    driver_with(root, lambda state: state.task(COARSE).checkpoint, seen).kill()
    driver = driver_with(root, lambda state: "running" in {it.status for it in state.tasks.values()}, seen)
    (head,) = (child for child in driver.children(recursive=True) if child.name() == "gcs_server")
    head.kill()
    _, stderr = process.communicate(timeout=480)
    assert process.returncode == 0, stderr
    assert "Traceback" not in stderr, stderr
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
