"""`panolog clean URL`: the only path that removes from a store, and what it leaves."""

import json
from pathlib import Path

import pytest

from panolog.orchestrator.runs.storage.layout import LEASES, MANIFESTS, OBJECTS, POINTERS, current
from panolog.orchestrator.runs.storage.lease import take
from panolog.scene.stores.store import Store, open_store
from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.runs.storage.stored_runs import Driver, fetched, mirror_of, rounds


def names(store: Store) -> dict[str, bytes | None]:
    return {name: store.read(name) for name in store.list() if not name.startswith(LEASES)}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A run that is done, after six checkpoints and two drivers."""
    found, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    for _ in range(2):
        mirror, lease = mirror_of(driver, found)
        for _ in range(3):
            driver.save()
            mirror.round()
        lease.release()
    mirror, lease = mirror_of(driver, found)
    driver.end()
    rounds(mirror)
    lease.release()
    return found


def test_drivers_remove_nothing_and_clean_all_that_is_superseded(store: Store, tmp_path: Path) -> None:
    checkpoints = f"{OBJECTS}/coarse/checkpoint.safetensors"
    before = names(store)
    assert len(store.list(checkpoints)) == 6 and len(store.list(POINTERS)) == 3
    assert call("clean", store.url, "--keep-manifests", 1, "--yes").exit_code == 0
    manifest = current(store)
    assert manifest is not None
    kept = {entry.key for entry in manifest.files.values()} | {manifest.name}
    left = names(store)
    assert set(store.list(OBJECTS)) | set(store.list(MANIFESTS)) == kept
    assert len(store.list(POINTERS)) == 1
    assert {name: before[name] for name in left} == left
    assert store.read("point_cloud.ply") == b"ply" * 1006  # results are not below .panolog
    fetched(store, tmp_path / "fresh")


def test_the_last_states_stay_whole(store: Store, tmp_path: Path) -> None:
    manifests = sorted(store.list(MANIFESTS))
    assert call("clean", store.url, "--keep-manifests", 3, "--yes").exit_code == 0
    assert sorted(store.list(MANIFESTS)) == manifests[-3:]
    assert len(store.list(f"{OBJECTS}/coarse/checkpoint.safetensors")) == 2  # of the 5th and the 6th
    again = call("clean", store.url, "--keep-manifests", 3, "--json")
    assert json.loads(again.stdout)["bytes"] == 0 and again.exit_code == 0


def test_nothing_is_removed_before_it_is_shown(store: Store) -> None:
    before = names(store)
    shown = call("clean", store.url, "--dry-run", "--keep-manifests", 1, "--json")
    (run,) = json.loads(shown.stdout)["runs"]
    assert (run["run"], run["files"] > 9, list(run["kinds"])) == (str(store.url), True, ["versions"])
    refused = call("clean", store.url, "--keep-manifests", 1)  # there is no terminal to confirm it
    assert refused.exit_code == 2 and "versions" in refused.stderr and "--yes" in refused.stderr
    assert names(store) == before


def test_a_run_at_work_is_left_as_it_is(store: Store, tmp_path: Path) -> None:
    before = names(store)
    lease = take(store, tmp_path / "run", force=False)
    result = call("clean", store.url, "--yes")
    assert "left as it is: a driver on " in result.stdout and names(store) == before
    assert "remove" not in result.stdout + call("clean", store.url).stdout
    lease.release()
    young = call("clean", store.url, "--yes", "--older-than", "1d")
    assert "left as it is: it was written 0.0 days ago" in young.stdout and names(store) == before


def test_a_damaged_store_is_left_as_it_is(store: Store) -> None:
    manifest = current(store)
    assert manifest is not None
    store.write(manifest.name, b"other")
    before = names(store)
    result = call("clean", store.url, "--yes")
    assert result.exit_code == 2 and "missing or damaged" in result.stdout
    assert names(store) == before


def test_what_makes_no_sense_of_a_store_is_one_line(store: Store, tmp_path: Path) -> None:
    for words in (["--blocks"], ["--keep-checkpoints", "2"], [str(tmp_path / "run")]):
        assert "takes no folders, --blocks and --keep-checkpoints" in one_line(
            call("clean", store.url, *words)
        )
    missing = call("clean", f"file://{tmp_path}/nowhere", "--yes")
    assert missing.exit_code == 2 and "there is no run" in missing.stdout
