"""The mirror of a run: the store is whole after every request, whatever fails, and has each file once."""

import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.records import Noticed, Outcome
from panolog.orchestrator.runs.storage.fetch import bring, for_status, viewed
from panolog.orchestrator.runs.storage.layout import (
    LEASES,
    MANIFESTS,
    OBJECTS,
    POINTERS,
    Manifest,
    StoredFile,
    current,
    mirrored,
    put_pointer,
)
from panolog.orchestrator.runs.storage.lease import holder, take
from panolog.orchestrator.runs.storage.mirror import Mirror
from panolog.orchestrator.runs.storage.state import MirrorState, read_state, write_state
from panolog.scene.errors import RunFolderError, StoreError, StoreLostError
from panolog.scene.files import write_bytes
from panolog.scene.stores.store import Store, open_store
from panolog.workers.tasks import COARSE
from tests.object_store import ObjectStore, object_store
from tests.orchestrator.runs.storage.stored_runs import Driver, Watched, fetched, mirror_of, rounds


def test_the_store_is_whole_after_every_change(tmp_path: Path) -> None:
    """Also while a run that a limit has ended is completed, whose results are replaced."""
    store = Watched(open_store(f"file://{tmp_path}/store").url)
    driver, seen, works = Driver(tmp_path / "run"), count(), [True]

    def look() -> None:
        if works[0]:
            driver.save()  # the driver proceeds within every round
        if current(store) is not None:
            fetched(store, tmp_path / f"fresh{next(seen)}")

    for outcome in (Outcome.LIMITED, Outcome.DONE):
        mirror, lease = mirror_of(driver, store)
        works[0], store.after = True, look
        for _ in range(3):
            mirror.round()
        works[0] = False
        driver.end(outcome)
        rounds(mirror)
        store.after = lambda: None
        lease.release()
        assert mirror.state.complete
        assert store.read("point_cloud.ply") == driver.folder.point_cloud.read_bytes()
    assert next(seen) > 10
    fresh = fetched(store, tmp_path / "last")
    assert files(fresh.root) == files(driver.folder.root) and len(files(fresh.root)) == 3


def stored(tmp_path: Path) -> tuple[Driver, Store, Mirror]:
    """A run with a checkpoint, of which a store has everything."""
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    mirror, _ = mirror_of(driver, store)
    driver.save()
    mirror.round()
    return driver, store, mirror


def files(root: Path) -> dict[str, bytes]:
    """All that a mirror copies, but for run.db, whose pages a copy may have in another order."""
    found = {path.relative_to(root).as_posix(): path for path in root.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in found.items() if mirrored(name)}


def test_nothing_that_was_replaced_is_removed_and_results_have_their_names(tmp_path: Path) -> None:
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    mirror, lease = mirror_of(driver, store)
    for _ in range(5):
        driver.save()
        mirror.round()
    assert len(store.list(f"{OBJECTS}/coarse/checkpoint.safetensors")) == 5  # `clean` removes those before
    driver.end()
    rounds(mirror)
    lease.release()
    assert holder(store) == ""
    assert store.read("point_cloud.ply") == b"ply" * 1005
    assert store.read("run.json") == driver.folder.info.read_bytes()
    second, lease = mirror_of(driver, store)  # as by `resume` of a run that is done: nothing is stored again
    before = store.list()
    rounds(second)
    lease.release()
    assert {it for it in store.list().keys() - before.keys() if "/leases/" not in it} == set()
    driver.save()  # as by `retry`
    third, _ = mirror_of(driver, store)
    was = {name: store.read(name) for name in store.list()}
    third.round()
    assert {name for name in was if store.read(name) != was[name]} == {max(store.list(LEASES))}
    assert len(store.list(POINTERS)) == 2  # of drivers that had something to publish


def test_a_run_that_was_refused_leaves_nothing(tmp_path: Path) -> None:
    """A refused run removes the files of its own from a store, and keeps those of others."""
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    store.write("notes.txt", b"of a user")
    mirror, lease = mirror_of(driver, store)
    mirror.round()
    assert current(store) is not None
    driver.folder.info.unlink()
    rounds(mirror)
    lease.release()
    assert mirror.state.complete
    assert {it for it in store.list() if "/leases/" not in it} == {"notes.txt"}


@pytest.mark.parametrize("folder", ["removed", "moved", "empty"])
@pytest.mark.parametrize("resumed", [False, True])
def test_a_folder_that_is_gone_takes_nothing_from_the_store(
    tmp_path: Path, folder: str, resumed: bool
) -> None:
    """By rm -rf before a fresh `resume`, mv, or a disk that is no longer mounted, while the mirror copies."""
    driver, store, mirror = stored(tmp_path)
    driver.end(Outcome.INTERRUPTED)
    mirror.round()
    if resumed:  # another mirror, which has made nothing of it itself
        mirror, _ = mirror_of(driver, store, force=True)
    before = {it: content for it in store.list() if "/leases/" not in it and (content := store.read(it))}
    if folder == "moved":
        driver.folder.root.rename(tmp_path / "elsewhere")
    else:
        shutil.rmtree(driver.folder.root)
    if folder == "empty":
        driver.folder.root.mkdir()
    rounds(mirror)
    assert {it: store.read(it) for it in before} == before
    assert not mirror.state.complete
    assert (
        mirror.state.problem == f"{driver.folder.root} is gone, or no run any more; the store keeps the run"
    )
    fetched(store, tmp_path / "fresh")


def test_a_checkpoint_that_is_lost_here_stays_in_the_store_and_is_reported(tmp_path: Path) -> None:
    driver, store, mirror = stored(tmp_path)
    driver.folder.checkpoint(COARSE).unlink()
    for number in range(3):
        driver._append(Noticed(None, str(number)))
        mirror.round()
        assert mirror.state.problem.endswith("kept in the store: coarse/checkpoint.safetensors")
        fetched(store, tmp_path / f"fresh{number}")
    driver.save()
    mirror.round()
    assert mirror.state.problem == ""


def test_what_a_killed_mirror_has_held_is_let_go(tmp_path: Path) -> None:
    driver, store, _ = stored(tmp_path)
    held = driver.folder.mirror.with_name("0123abcd.part")
    held.write_bytes(b"of a checkpoint")
    mirror_of(driver, store, force=True)
    assert not held.exists()


def test_a_store_that_fails_delays_only_the_mirror_and_says_so(tmp_path: Path) -> None:
    store, driver = Watched(open_store(f"file://{tmp_path}/store").url), Driver(tmp_path / "run")
    mirror, _ = mirror_of(driver, store)
    driver.save()
    failing = iter([True] * 3)

    def fail() -> None:
        if next(failing, False):
            raise StoreLostError("the store fails (503)")

    store.after = fail
    stopped = threading.Event()
    stopped.set()
    mirror.follow(threading.Event(), stopped, 0.01, 300.0)  # until the first failure
    state = read_state(driver.folder.mirror)
    assert state is not None
    assert state.problem == "the store fails (503)"
    assert state.late
    assert "nothing is in" in state.line
    driver.end()
    rounds(mirror)
    state = read_state(driver.folder.mirror)
    assert state is not None
    assert (state.complete, state.problem, state.lag) == (True, "", 0.0)
    fetched(store, tmp_path / "fresh")


def test_a_mirror_without_a_store_gives_up_and_keeps_what_is_left_in_mind(tmp_path: Path) -> None:
    store, driver = Watched(open_store(f"file://{tmp_path}/store").url), Driver(tmp_path / "run")
    mirror, _ = mirror_of(driver, store)
    driver.end()

    def fail() -> None:
        raise StoreLostError("the store fails (503)")

    store.after = fail
    rounds(mirror, patience=0.05)
    assert (mirror.state.complete, mirror.state.problem) == (False, "the store fails (503)")


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    store = open_store(f"file://{tmp_path}/store")
    store.write("a", b"old" * 1000)
    with (tmp_path / "store" / "a").open("rb") as before:
        store.write("a", b"new")
        assert before.read() == b"old" * 1000


def test_a_mirror_that_was_killed_after_its_pointer_leaves_a_folder_that_is_kept(tmp_path: Path) -> None:
    driver, store, _ = stored(tmp_path)
    state = read_state(driver.folder.mirror)
    assert state is not None
    write_state(driver.folder.mirror, replace(state, published="before"))
    bring(store, driver.folder, current(store), pytest.fail)
    assert driver.folder.info.exists()


def test_a_damaged_store_is_one_line(tmp_path: Path) -> None:
    _, store, mirror = stored(tmp_path)
    (checkpoint,) = store.list(f"{OBJECTS}/coarse/checkpoint.safetensors")
    store.write(checkpoint, b"other")
    with pytest.raises(StoreError, match="its digest differs"):
        fetched(store, tmp_path / "fresh")
    assert not RunFolder(tmp_path / "fresh").info.exists()
    store.write(mirror.state.published, b"other")
    with pytest.raises(StoreError, match="missing or damaged"):
        current(store)


@pytest.mark.parametrize("name", ["../x", "/x", "control/stop", "lock"])
def test_a_manifest_that_names_what_is_no_file_of_a_run_is_refused(tmp_path: Path, name: str) -> None:
    store = open_store(f"file://{tmp_path}/store")
    manifest = Manifest(f"{MANIFESTS}/x", {name: StoredFile("k", 1, "0", 0)})
    store.write(manifest.name, manifest.pack())
    put_pointer(store, 1, manifest, manifest.pack())
    with pytest.raises(StoreError, match="no file of a run"):
        current(store)


def test_which_folder_is_brought_up_to_date_and_which_is_kept(tmp_path: Path) -> None:
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    mirror, lease = mirror_of(driver, store)
    driver.save()
    mirror.round()
    lines: list[str] = []
    driver.save()  # newer than the store: this machine has gone on
    bring(store, driver.folder, current(store), lines.append)
    assert int(driver.folder.checkpoint(COARSE).read_bytes()) == 2
    assert lines == []
    other = fetched(store, tmp_path / "other")
    lease.release()
    second = Mirror(other, store, take(store, other.root, force=False), current(store))
    write_bytes(other.report, b"continued")
    second.round()
    bring(store, driver.folder, current(store), lines.append)
    assert int(driver.folder.checkpoint(COARSE).read_bytes()) == 1
    assert "another machine has continued this run" in lines[0]
    (aside,) = tmp_path.glob("run.before-*")
    assert int(RunFolder(aside).checkpoint(COARSE).read_bytes()) == 2
    with pytest.raises(RunFolderError, match="choose another folder"):
        bring(open_store(f"file://{tmp_path}/elsewhere"), other, None, lines.append)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(RunFolderError, match="is not empty"):
        bring(store, RunFolder(tmp_path / "full"), current(store), lines.append)


def test_a_reader_gets_what_it_needs(tmp_path: Path) -> None:
    _, store, _ = stored(tmp_path)
    with viewed(store.url, for_status) as (root, driven):
        names = {path.name for path in root.rglob("*") if path.is_file()}
        assert names == {"run.json", "run.db"}
        assert driven
    with (
        pytest.raises(StoreError, match="there is no run"),
        viewed(open_store(f"file://{tmp_path}/x").url, for_status),
    ):
        pass


@pytest.mark.parametrize("content", [b"", b"[]", b'{"url": 3}', b'{"url": "s3://x", "since": "y"}', b"\xff"])
def test_a_damaged_state_is_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "state.json").write_bytes(content)
    assert read_state(tmp_path / "state.json") is None


def test_a_mirror_that_is_silent_is_a_problem(tmp_path: Path) -> None:
    path = tmp_path / "store" / "state.json"
    write_state(path, MirrorState("s3://x/y", since=1.0))
    assert read_state(path, running=True) == read_state(path)
    content: dict[str, Any] = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"time": 1.0}))
    state = read_state(path, running=True)
    assert state is not None
    assert "the mirror has ended" in state.line


@pytest.fixture(scope="module")
def server() -> Iterator[ObjectStore]:
    with object_store() as found:
        yield found


@pytest.mark.system
def test_through_s3_with_faults_nothing_is_lost_and_nothing_doubled(
    tmp_path: Path, server: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    store = open_store(server.url("run"))
    driver = Driver(tmp_path / "run")
    mirror, lease = mirror_of(driver, store)
    for _ in range(4):
        driver.save()
        server.faults += ["lost answer", "throttled", "reset", "error", "truncated"]
        with suppress(StoreLostError):
            mirror.round()
    driver.end()
    rounds(mirror)
    lease.release()
    assert mirror.state.complete
    assert not server.faults
    assert all(server.injected[kind] for kind in ("lost answer", "throttled", "reset", "error", "truncated"))
    fresh = fetched(store, tmp_path / "fresh")
    assert files(fresh.root) == files(driver.folder.root)
    named = current(store)
    assert named is not None
    stored = [name.rpartition("/")[0] for name in store.list(OBJECTS)]
    assert (
        stored.count(f"{OBJECTS}/coarse/checkpoint.safetensors") <= 2 * 4
    )  # each once, or with an answer lost
    assert stored.count(f"{OBJECTS}/point_cloud.ply") <= 2
