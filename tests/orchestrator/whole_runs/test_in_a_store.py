"""A run from and into an object store, whose head is lost in Stage II with its disk."""

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import RunBegan
from panolog.orchestrator.run.store import read_records
from panolog.orchestrator.storage.layout import OBJECTS, current
from panolog.orchestrator.storage.lease import holder
from panolog.scene.stores.store import Store, open_store
from panolog.synthetic.make import make_town
from panolog.workers.tasks import COARSE
from tests.object_store import ObjectStore, object_store
from tests.orchestrator.follower.test_whole_run import SECRET, files_with_secrets, observed
from tests.orchestrator.whole_runs.test_supervised import driver_with
from tests.orchestrator.whole_runs.test_whole_runs import SETTINGS, Accident, end_of, launch

pytestmark = pytest.mark.system

# No signal at all: but the worker waits after its first checkpoint, so that the run stays in Stage II.
HELD_IN_A_BLOCK: list[Accident] = [("CheckpointSaved", "block/000", "worker", 0)]


LONG = (*SETTINGS, "--iterations", "120")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("stored") / "town", panoramas=9, width=64, points=300)


@pytest.fixture(scope="module")
def calm(town: Path) -> RunFolder:
    """An undisturbed run."""
    folder = RunFolder(town.with_name("calm"))
    ended = end_of(launch("run", town, "-o", folder.root, *LONG))
    assert ended.code == 0, ended.stderr
    return folder


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


def wait_until(ready: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.2)


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
        first = launch("run", scene, "-o", run, *LONG, accidents=HELD_IN_A_BLOCK)
        wait_until(lambda: first.poll() is not None or has(store, "blocks/000/checkpoint.safetensors"))
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


def test_a_supervised_run_and_its_mirror_survive_that_each_is_killed(
    tmp_path: Path, town: Path, calm: RunFolder, server: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "store"
    monkeypatch.setenv("PANOLOG_STORE_CACHE", str(cache))
    monkeypatch.setenv("PANOLOG_STORE_SECONDS", "0.2")
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    scene, url = stored(town, server), server.url("supervised")
    store = open_store(url)
    root, killed = tmp_path / "run", list[int]()
    process = launch("run", scene, "-o", url, "--local", root, "--supervise", *LONG)
    driver_with(root, lambda state: state.task(COARSE).checkpoint, killed).kill()
    driver_with(root, lambda state: state.task(COARSE).status == "running", killed)
    (mirror,) = mirrors(cache)
    mirror.kill()
    ended = end_of(process)
    assert ended.code == 0, ended.stderr
    assert "its mirror was killed (code -9); another one is at work" in ended.stderr
    assert "resume 1 of at most" in ended.stderr
    check_results(store, RunFolder(root), calm)
    assert mirrors(cache) == []


def check_results(store: Store, new: RunFolder, calm: RunFolder) -> None:
    """The run has been resumed, and has the bytes of an undisturbed one; the store has all of it once."""
    drivers = [it.record for it in read_records(new.database) if isinstance(it.record, RunBegan)]
    assert [it.resumed for it in drivers] == [False, True]
    names = ("coarse/model.ply", "blocks/000/model.ply", "blocks/001/model.ply", "point_cloud.ply")
    for name in (*names, "partition/plan.json", "eval/seams.json"):
        assert (new.root / name).read_bytes() == (calm.root / name).read_bytes(), name
    assert store.read("point_cloud.ply") == calm.point_cloud.read_bytes()
    assert holder(store) == ""
    manifest = current(store)
    assert manifest is not None
    assert not any(name.endswith("checkpoint.safetensors") for name in manifest.files)
    assert set(store.list(f"{OBJECTS}/coarse/model.ply")) == {manifest.files["coarse/model.ply"].key}
