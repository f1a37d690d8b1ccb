"""A run from and into a store, which goes on where its folder is lost with its disk."""

import os
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import closing, nullcontext, suppress
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from panolog.orchestrator.cli import app
from panolog.orchestrator.cluster import connection
from panolog.orchestrator.commands import session
from panolog.orchestrator.driver.local_pool import LocalPool, local_pool
from panolog.orchestrator.resources.nodes import Placement
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.state import ignore
from panolog.orchestrator.run.store import read_records
from panolog.orchestrator.storage.layout import OBJECTS, current
from panolog.orchestrator.storage.lease import holder
from panolog.scene.stores.store import Store, open_store
from panolog.synthetic.make import make_town
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import Stage
from tests.object_store import ObjectStore, object_store
from tests.orchestrator.follower.test_whole_run import SECRET, files_with_secrets, observed
from tests.orchestrator.whole_runs.test_whole_runs import SETS, SETTINGS, Accident, end_of, launch, same_bytes
from tests.ray_head import wait_until

pytestmark = pytest.mark.system

# No signal at all: but the worker waits after its first checkpoint, so that the run stays in Stage II.
HELD_IN_A_BLOCK: list[Accident] = [("CheckpointSaved", "block/000", "worker", 0)]


BLOCK = "blocks/000/checkpoint.safetensors"


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("stored") / "town", panoramas=9, width=64, points=300)


@pytest.fixture(scope="module")
def calm(town: Path) -> RunFolder:
    """An undisturbed run."""
    folder = RunFolder(town.with_name("calm"))
    with local_pool() as pool:
        session.start(town, folder.root, load_config(sets=SETS), None, ignore, pool)
    return folder


class Interrupted(LocalPool):
    """Ctrl-C when Stage I has ended."""

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        if spec.task.stage == Stage.BLOCK:
            raise KeyboardInterrupt
        super().start(placement, spec)


def test_a_run_in_a_store_goes_on_in_an_empty_folder(
    tmp_path: Path, town: Path, calm: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PANOLOG_STORE_CACHE", str(tmp_path / "cache"))
    run, first, second = f"file://{tmp_path}/store", tmp_path / "first", tmp_path / "second"
    commands = (
        ["run", town.as_uri(), "-o", run, "--local", first, *SETTINGS],
        ["resume", run, "--local", second],
    )
    for words, pool, code in zip(commands, (Interrupted(), LocalPool()), (130, 0), strict=True):
        with closing(pool):
            monkeypatch.setattr(connection, "connect", lambda *_, pool=pool: nullcontext(pool))
            ended = CliRunner().invoke(app.app, [str(word) for word in words])
        assert ended.exit_code == code, ended.output
        shutil.rmtree(first, ignore_errors=True)
    check_results(open_store(run), RunFolder(second), calm)


@pytest.fixture
def server() -> Iterator[ObjectStore]:
    with object_store() as found:
        yield found


def mirrors(cache: Path) -> list[psutil.Process]:
    """The processes of mirrors whose cache is in a folder."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if "panolog.orchestrator.storage" in process.cmdline() and process.environ().get(
                "PANOLOG_STORE_CACHE"
            ) == str(cache):
                found.append(process)
    return found


def stored(scene: Path, server: ObjectStore) -> str:
    """The URL of a scene after all of it is in the store."""
    place = open_store(server.url("town"))
    for path in scene.rglob("*"):
        if path.is_file():
            place.put(path, path.relative_to(scene).as_posix())
    return str(place.url)


def has(store: Store, name: str) -> bool:
    manifest = current(store)
    return manifest is not None and name in manifest.files


@pytest.mark.nightly  # all at once: Ray, a real server with faults, kills; each has tests of its own
def test_a_head_that_is_lost_with_its_disk_is_replaced(
    tmp_path: Path, town: Path, calm: RunFolder, server: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, cache = time.time(), tmp_path / "first" / "store"
    monkeypatch.setenv("PANOLOG_STORE_CACHE", str(cache))
    monkeypatch.setenv("PANOLOG_STORE_SECONDS", "0.2")
    monkeypatch.setenv("PANOLOG_LOG", "DEBUG")
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    scene, run = stored(town, server), server.url("run")
    store = open_store(run)
    with observed() as seen:
        first = launch("run", scene, "-o", run, *SETTINGS, accidents=HELD_IN_A_BLOCK)
        wait_until(lambda: first.poll() is not None or has(store, BLOCK), "the block in the store", 300)
        refused = end_of(launch("resume", run, "--local", tmp_path / "other"))
        status = end_of(launch("status", run, "--json"))
        for process in mirrors(cache):
            process.kill()
        os.killpg(first.pid, signal.SIGKILL)
        lost = end_of(first)
        shutil.rmtree(tmp_path / "first")
        monkeypatch.setenv("PANOLOG_STORE_CACHE", str(tmp_path / "second" / "store"))
        server.faults += ["throttled", "reset", "truncated", "error", "lost answer", "slow"] * 2
        second = end_of(launch("resume", run, "--force", "--local", tmp_path / "new"))
    assert lost.code == -9, lost.stderr
    assert (refused.code, refused.stdout) == (2, "")
    assert "is at work on it; stop that one first" in refused.stderr
    assert '"status": "running"' in status.stdout, status.stderr
    assert second.code == 0, second.stderr
    assert not server.faults
    check_results(store, RunFolder(tmp_path / "new"), calm)
    assert (seen.commands, seen.files) == (set(), set())
    said = "".join(end.stdout + end.stderr for end in (refused, status, lost, second))
    assert SECRET.decode() not in said
    assert files_with_secrets(tmp_path, began) == []
    assert all(SECRET not in (store.read(name) or b"") for name in store.list())


def check_results(store: Store, new: RunFolder, calm: RunFolder) -> None:
    """The run has been resumed, and has the bytes of an undisturbed one; the store has all of it once."""
    drivers = [it.record for it in read_records(new.database) if isinstance(it.record, RunBegan)]
    assert [it.resumed for it in drivers] == [False, True]
    same_bytes(new.root, calm.root)
    assert store.read("point_cloud.ply") == calm.point_cloud.read_bytes()
    assert holder(store) == ""
    manifest = current(store)
    assert manifest is not None
    assert not any(name.endswith("checkpoint.safetensors") for name in manifest.files)
    assert set(store.list(f"{OBJECTS}/coarse/model.ply")) == {manifest.files["coarse/model.ply"].key}
