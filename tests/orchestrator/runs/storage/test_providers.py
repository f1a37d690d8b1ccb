"""Stores of each provider's protocol: what our code relies on holds in all of them."""

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fsspec import get_filesystem_class

from panolog.orchestrator.runs.storage.lease import holder
from panolog.scene.errors import StoreError
from panolog.scene.stores.store import open_store
from tests.cloud_stores import PROTOCOLS, SECRET, CloudStore, cloud_store
from tests.orchestrator.runs.storage.stored_runs import Driver, fetched, mirror_of, rounds
from tests.orchestrator.watch.follower.receivers import receiver

pytestmark = pytest.mark.system
AZURE = pytest.param("az", marks=pytest.mark.nightly)  # its server is installed from npm


@pytest.fixture(scope="module", params=[AZURE if name == "az" else name for name in PROTOCOLS])
def server(request: pytest.FixtureRequest) -> Iterator[CloudStore]:
    with cloud_store(request.param) as found:
        yield found


def test_objects_are_stored_listed_read_copied_and_removed(server: CloudStore, tmp_path: Path) -> None:
    store = open_store(server.url("basic"), 5.0)
    assert (store.list(), store.version("a")) == ({}, None)
    assert store.read("a") is store.read("a", 2, 5) is None
    large = tmp_path / "large"
    large.write_bytes(os.urandom(6 * 2**20))  # in several parts, where a provider has them
    store.put(large, "folder/large")
    store.write("odd/ä b+c%20#1.jpg", b"0123456789")
    store.write("empty", b"")
    found = store.list()
    assert {name: version.size for name, version in found.items()} == {
        "folder/large": 6 * 2**20,
        "odd/ä b+c%20#1.jpg": 10,
        "empty": 0,
    }
    assert all(version == store.version(name) for name, version in found.items())
    assert all(version.tag and version.modified > 1e9 for version in found.values())
    assert store.list("folder") == {"folder/large": found["folder/large"]}
    assert (store.list("fold"), open_store(server.url("basic/empty"), 5.0).list()) == ({}, {})
    assert store.read("odd/ä b+c%20#1.jpg", 2, 5) == b"234"
    assert store.read_whole("folder/large", found["folder/large"]) == large.read_bytes()
    store.copy("folder/large", "copy")
    store.get("copy", tmp_path / "got", store.version("copy"))
    assert (tmp_path / "got").read_bytes() == large.read_bytes()
    for _ in range(2):
        store.remove("copy")
    assert store.read("copy") is None


def test_an_object_that_has_changed_or_is_gone_is_noticed(server: CloudStore) -> None:
    store = open_store(server.url("changes"), 5.0)
    store.write("a", b"before")
    version = store.version("a")
    assert version is not None
    store.write("a", b"after!")  # of the same size
    with pytest.raises(StoreError, match="has changed in the store"):
        store.read_whole("a", version)
    store.remove("a")
    with pytest.raises(StoreError, match="there is no such object"):
        store.read_whole("a", version)


def test_of_many_that_make_an_object_one_succeeds(server: CloudStore) -> None:
    store, ready = open_store(server.url("exclusive"), 5.0), threading.Barrier(8)

    def make(number: int) -> bool:
        ready.wait()
        return store.write("lease", b"%d" % number, new=True)

    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(make, range(8)))
    assert made.count(True) == 1
    assert store.read("lease") == b"%d" % made.index(True)


def test_a_missing_bucket_is_the_users_at_once(server: CloudStore) -> None:
    with pytest.raises(StoreError, match="there is no such object"):
        open_store(f"{server.protocol}://no-such-bucket/x").write("a", b"")
    assert open_store(f"{server.protocol}://no-such-bucket/x").list() == {}


def test_a_run_is_mirrored_and_comes_back_without_the_providers_secret(
    server: CloudStore, tmp_path: Path
) -> None:
    store, driver = open_store(server.url("run"), 5.0), Driver(tmp_path / "run")
    mirror, lease = mirror_of(driver, store)
    for _ in range(2):
        driver.save()
        mirror.round()
    driver.end()
    rounds(mirror)
    lease.release()
    assert (mirror.state.complete, holder(store)) == (True, "")
    fresh = fetched(store, tmp_path / "fresh")
    assert fresh.point_cloud.read_bytes() == driver.folder.point_cloud.read_bytes()
    assert store.read("point_cloud.ply") == driver.folder.point_cloud.read_bytes()
    assert SECRET.encode() not in b"".join(store.read(name) or b"" for name in store.list())


@pytest.mark.parametrize("server", [AZURE], indirect=True)
def test_the_account_of_an_azure_url_is_the_one_that_is_used(server: CloudStore) -> None:
    named = open_store("abfs://places@account.dfs.core.windows.net/named", 5.0)
    named.write("a", b"x")
    assert open_store(server.url("named"), 5.0).read("a") == b"x"
    with pytest.raises(StoreError, match="are of the account account; set those of other"):
        open_store("abfs://places@other.dfs.core.windows.net/named")


@pytest.mark.parametrize("server", [AZURE], indirect=True)
def test_an_azure_copy_that_is_answered_before_it_is_made_is_awaited(
    server: CloudStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(server.url("late"), 5.0)
    store.write("a", b"0123456789")
    files: Any = store._files
    looks, info = [0], files.info

    def late(key: str) -> dict[str, Any]:
        if key.endswith("/b"):
            looks[0] += 1
            return {**info(key), "size": 0} if looks[0] < 3 else info(key)
        found: dict[str, Any] = info(key)
        return found

    monkeypatch.setattr(files, "info", late)
    store.copy("a", "b")
    assert looks == [3]


@pytest.mark.parametrize("server", [AZURE], indirect=True)
@pytest.mark.parametrize("key", ["b3RoZXI=", ""])
def test_credentials_that_azure_refuses_are_the_users_at_once(
    server: CloudStore, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = server.environment["AZURE_STORAGE_CONNECTION_STRING"]
    monkeypatch.setenv("AZURE_STORAGE_CONNECTION_STRING", words.replace(SECRET, key))
    get_filesystem_class("abfs").clear_instance_cache()
    with pytest.raises(StoreError, match=r"no access .*; set the provider's credentials"):
        open_store(server.url("refused")).read("a")
    get_filesystem_class("abfs").clear_instance_cache()


@pytest.mark.parametrize("server", ["gs"], indirect=True)
@pytest.mark.parametrize("status", [401, 403])
def test_an_answer_of_google_that_refuses_access_is_the_users_at_once(
    server: CloudStore, status: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with receiver([status] * 9) as google:
        monkeypatch.setenv("STORAGE_EMULATOR_HOST", google.url)
        get_filesystem_class("gs").clear_instance_cache()
        with pytest.raises(StoreError, match=r"no access .*; set the provider's credentials"):
            open_store(server.url("refused")).list()
        get_filesystem_class("gs").clear_instance_cache()
    assert capfd.readouterr().err == ""
