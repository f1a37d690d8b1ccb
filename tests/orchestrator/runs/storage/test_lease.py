"""Leases: one driver at a time writes a run in a store."""

import os
from pathlib import Path

import pytest

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.storage import lease as leases
from panolog.orchestrator.runs.storage.layout import LEASES, current, newest
from panolog.orchestrator.runs.storage.lease import holder, take
from panolog.orchestrator.runs.storage.mirror import Mirror
from panolog.scene.errors import RunLockedError
from panolog.scene.stores.store import open_store
from tests.orchestrator.runs.storage.stored_runs import Driver, mirror_of
from tests.ray_head import wait_until


def test_one_driver_at_a_time(tmp_path: Path) -> None:
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    mirror, lease = mirror_of(driver, store)
    driver.save()
    mirror.round()
    assert holder(store).startswith("a driver on ")
    with pytest.raises(RunLockedError, match=r"is at work on it; stop that one first.*--force") as found:
        take(store, tmp_path / "elsewhere", force=False)
    assert "\n" not in str(found.value)
    newer = take(store, tmp_path / "elsewhere", force=True)
    driver.save()
    with pytest.raises(RunLockedError, match="has taken the run over"):
        mirror.round()
    assert lease.lost
    named = current(store)
    assert named is not None
    assert named.name == mirror.state.published  # what the newer one continues from
    Mirror(driver.folder, store, newer, named).round()
    newer.release()
    assert holder(store) == ""
    take(store, tmp_path / "elsewhere", force=False)


def test_the_mirror_of_a_live_driver_is_replaced_but_not_that_of_another(tmp_path: Path) -> None:
    store, driver = open_store(f"file://{tmp_path}/store"), Driver(tmp_path / "run")
    with lock.hold(driver.folder.lock):
        mirror_of(driver, store)
        with pytest.raises(RunLockedError):
            take(store, driver.folder.root, force=False)
        take(store, driver.folder.root, force=False, again=True)
        with pytest.raises(RunLockedError):
            take(store, tmp_path / "elsewhere", force=False, again=True)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'{"time": "now"}'])
def test_a_lease_that_cannot_be_read_is_held(tmp_path: Path, content: bytes) -> None:
    store = open_store(f"file://{tmp_path}/store")
    take(store, tmp_path / "run", force=False).end()
    (name,) = store.list(LEASES)
    store.write(name, content)
    with pytest.raises(RunLockedError, match="a driver on another machine is at work"):
        take(store, tmp_path / "run", force=False)
    os.utime(tmp_path / "store" / name, (1, 1))
    take(store, tmp_path / "run", force=False)


def test_containers_with_one_host_name_are_two_machines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One does not wait for the other in silence: only this machine's mirror is about to end."""
    store = open_store(f"file://{tmp_path}/store")
    boot = tmp_path / "boot_id"
    for number in ("1", "2"):
        boot.write_text(number)
        monkeypatch.setattr(leases, "_BOOT", boot)
        if number == "1":
            take(store, tmp_path / "run", force=False)
    with pytest.raises(RunLockedError, match="is at work on it"):
        take(store, tmp_path / "run", force=False)


def test_a_lease_is_written_again_until_it_ends_and_then_expires(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "_REFRESH_S", 0.01)
    store = open_store(f"file://{tmp_path}/store")
    lease = take(store, tmp_path / "elsewhere", force=False)
    name = newest(store, LEASES)  # next to it there may be the file that takes its place
    assert name is not None
    first = store.read(name)
    wait_until(lambda: store.read(name) != first, "it is written again")
    lease.end()
    monkeypatch.setattr(leases, "EXPIRES_S", 0.0)
    take(store, tmp_path / "elsewhere", force=False)
