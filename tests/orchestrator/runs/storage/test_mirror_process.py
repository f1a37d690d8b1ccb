"""The process of a mirror: it is kept alive, and takes no signal from a supervisor that waits for one."""

import signal
import sys
import threading
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.runs.machines.children import Companion
from panolog.orchestrator.runs.storage import mirror_process
from panolog.orchestrator.runs.storage.lease import take
from panolog.orchestrator.runs.storage.mirror_process import mirrored
from panolog.orchestrator.runs.storage.mirror_settings import MirrorSettings
from panolog.scene.errors import RunError
from panolog.scene.stores.store import open_store
from tests.orchestrator.runs.storage.stored_runs import Driver, fetched
from tests.ray_head import living, wait_until

pytestmark = pytest.mark.system


def plan_of(tmp_path: Path) -> MirrorSettings:
    return MirrorSettings(
        tmp_path / "run", f"file://{tmp_path}/store", resumes=False, period=0.05, patience=300.0
    )


def blocked(path: Path) -> set[int]:
    """The signals that a thread, or a process, has blocked. Args: path, of its folder in /proc."""
    lines = dict(line.split(":", 1) for line in (path / "status").read_text().splitlines())
    mask = int(lines["SigBlk"], 16)
    return {number for number in range(1, 65) if mask >> (number - 1) & 1}


def mirror() -> psutil.Process:
    (found,) = living("panolog.orchestrator.runs.storage")
    return found


def test_a_mirror_that_is_killed_is_replaced_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirror_process, "_AGAIN_S", 0.0)
    said = list[str]()
    with mirrored(plan_of(tmp_path), said.append):
        driver = Driver(tmp_path / "run")
        (thread,) = (it for it in threading.enumerate() if it.name == "mirror")
        assert blocked(Path(f"/proc/self/task/{thread.native_id}")) >= {signal.SIGTERM, signal.SIGINT}
        assert signal.SIGTERM not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
        first = mirror()
        driver.save()
        first.kill()
        wait_until(lambda: len(said) == 2, "another mirror")
        second = mirror()
        assert second.pid != first.pid
        status = Path(f"/proc/{second.pid}")  # libc blocks all signals for moments
        wait_until(lambda: signal.SIGTERM not in blocked(status), "a mirror that can be stopped")
        driver.end()
    assert said[1] == f"file://{tmp_path}/store: its mirror was killed (code -9); another one is at work"
    store = open_store(f"file://{tmp_path}/store")
    assert store.read("point_cloud.ply") == driver.folder.point_cloud.read_bytes()
    fetched(store, tmp_path / "fresh")


def test_a_mirror_that_cannot_be_replaced_is_reported_at_once_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mirror_process, "_AGAIN_S", 0.0)
    said, store = list[str](), open_store(f"file://{tmp_path}/store")
    with pytest.raises(RunError, match="is at work on it"), mirrored(plan_of(tmp_path), said.append):
        driver = Driver(tmp_path / "run")
        first = mirror()
        first.suspend()  # it does not notice
        lease = take(store, tmp_path / "other", force=True)  # another machine takes the run
        first.kill()
        wait_until(lambda: len(said) == 2, "why there is no mirror")
        driver.end()
    assert "its mirror was killed (code -9), and another one cannot work" in said[1]
    lease.release()


def test_a_mirror_that_fails_each_time_is_given_up_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the end of the run nothing is waited for: it would be started as fast as it fails."""
    plans, program = list[str](), "print('{\"ready\": true}', flush=True); input(); input()"

    def start(_: str, plan: str) -> Companion:
        plans.append(plan)
        return Companion([sys.executable, "-c", program], plan)

    monkeypatch.setattr(mirror_process, "start_companion", start)
    with pytest.raises(RunError, match=r"was killed \(code 1: EOFError"), mirrored(plan_of(tmp_path), print):
        pass
    assert len(plans) == 1 + mirror_process._TRIES
